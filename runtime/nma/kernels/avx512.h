// x86-64 with AVX-512 F, BW, DQ and VL: sixteen lanes, 32 registers.
#pragma once

#include <immintrin.h>

#include "../recipe.h"
#include "macros.h"

#define NMA_FN NMA_TARGET("avx512f,avx512bw,avx512dq,avx512vl,fma")
#define NMA_OP NMA_FN NMA_INLINE

namespace nma::avx512 {

constexpr int LANES = 16, SINGLE_TILE = 4, BATCH_TILE = 4, BATCH_QUERIES = 6;

using Vec = __m512;

// All lanes. GCC 12 warns of its own headers where an intrinsic takes no mask (bug 105593).
constexpr __mmask16 ALL = 0xffff;

NMA_OP Vec load(const float* p) { return _mm512_load_ps(p); }
NMA_OP void store(float* p, Vec v) { _mm512_store_ps(p, v); }
NMA_OP Vec set(float x) { return _mm512_set1_ps(x); }
NMA_OP Vec add(Vec a, Vec b) { return _mm512_add_ps(a, b); }
NMA_OP Vec mul(Vec a, Vec b) { return _mm512_mul_ps(a, b); }
NMA_OP Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a, b, c); }
// 14 bits, doubled by a step of Newton: a division takes twice as long.
NMA_OP Vec inverse(Vec a) {
    const Vec near = _mm512_maskz_rcp14_ps(ALL, a);
    return fma(near, _mm512_fnmadd_ps(a, near, set(1.0f)), near);
}
NMA_OP Vec max(Vec a, Vec b) { return _mm512_maskz_max_ps(ALL, a, b); }
NMA_OP Vec min(Vec a, Vec b) { return _mm512_maskz_min_ps(ALL, a, b); }
NMA_OP Vec nearest(Vec x) { return _mm512_maskz_roundscale_ps(ALL, x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
NMA_OP Vec scale(Vec a, Vec whole) { return _mm512_maskz_scalef_ps(ALL, a, whole); }
NMA_OP __m512i raw(const std::uint32_t* pairs) { return _mm512_load_si512(pairs); }
NMA_OP Vec even(const std::uint32_t* pairs) { return _mm512_castsi512_ps(_mm512_maskz_slli_epi32(ALL, raw(pairs), 16)); }
NMA_OP Vec odd(const std::uint32_t* pairs) { return _mm512_castsi512_ps(_mm512_and_si512(raw(pairs), _mm512_set1_epi32(-65536))); }

#include "body.inl"

}  // namespace nma::avx512

#undef NMA_FN
#undef NMA_OP
