// x86-64 with AVX2 and FMA: eight lanes, 16 registers.
#pragma once

#include <immintrin.h>

#include "../preparation.h"
#include "macros.h"

#define NMA_FN NMA_TARGET("avx2,fma")
#define NMA_OP NMA_FN NMA_INLINE

namespace nma::avx2 {

constexpr int VEC_SIZE = 8, SINGLE_TILE = 8, BATCH_TILE = 2, BATCH_QUERIES = 6;

using Vec = __m256;

NMA_OP Vec load(const float* p) { return _mm256_load_ps(p); }
NMA_OP void store(float* p, Vec v) { _mm256_store_ps(p, v); }
NMA_OP Vec set(float x) { return _mm256_set1_ps(x); }
NMA_OP Vec add(Vec a, Vec b) { return _mm256_add_ps(a, b); }
NMA_OP Vec sub(Vec a, Vec b) { return _mm256_sub_ps(a, b); }
NMA_OP Vec mul(Vec a, Vec b) { return _mm256_mul_ps(a, b); }
NMA_OP Vec inverse(Vec a) { return _mm256_div_ps(set(1.0f), a); }
NMA_OP Vec fma(Vec a, Vec b, Vec c) { return _mm256_fmadd_ps(a, b, c); }
NMA_OP Vec max(Vec a, Vec b) { return _mm256_max_ps(a, b); }
NMA_OP Vec min(Vec a, Vec b) { return _mm256_min_ps(a, b); }
NMA_OP Vec nearest(Vec x) { return _mm256_round_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
NMA_OP Vec scale(Vec a, Vec whole) {
    return mul(a, _mm256_castsi256_ps(
                      _mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(whole), _mm256_set1_epi32(127)), 23)));
}
NMA_OP __m256i raw(const std::uint32_t* pairs) { return _mm256_load_si256(reinterpret_cast<const __m256i*>(pairs)); }
NMA_OP Vec even(const std::uint32_t* pairs) { return _mm256_castsi256_ps(_mm256_slli_epi32(raw(pairs), 16)); }
NMA_OP Vec odd(const std::uint32_t* pairs) {
    return _mm256_castsi256_ps(_mm256_and_si256(raw(pairs), _mm256_set1_epi32(-65536)));
}

using Few = Indexed;  // in memory

#include "body.inl"

}  // namespace nma::avx2

#undef NMA_FN
#undef NMA_OP
