// Plain C++ with four lanes, which compilers translate to the vector instructions of the target CPU.
#pragma once

#include <cmath>
#include <cstring>

#include "../preparation.h"
#include "macros.h"

#define NMA_FN
#define NMA_OP NMA_INLINE

namespace nma::portable {

constexpr int VEC_SIZE = 4, SINGLE_TILE = 4, BATCH_TILE = 4, BATCH_QUERIES = 2;

#if defined(__GNUC__)
using Vec = detail::Floats;
#else
struct Vec {
    float lanes[VEC_SIZE];
    float& operator[](int k) { return lanes[k]; }
    float operator[](int k) const { return lanes[k]; }
};
#endif

template <class F>
NMA_OP Vec each(F function) {
    Vec r{};
    NMA_UNROLL for (int k = 0; k < VEC_SIZE; ++k) r[k] = function(k);
    return r;
}

NMA_OP float from_bits(std::uint32_t bits) {
    float value;
    std::memcpy(&value, &bits, 4);
    return value;
}

NMA_OP Vec load(const float* p) {
    Vec v;
    std::memcpy(&v, p, sizeof(v));
    return v;
}
NMA_OP void store(float* p, Vec v) { std::memcpy(p, &v, sizeof(v)); }
NMA_OP Vec set(float x) {
    return each([&](int) { return x; });
}
#if defined(__GNUC__)
NMA_OP Vec add(Vec a, Vec b) { return a + b; }
NMA_OP Vec sub(Vec a, Vec b) { return a - b; }
NMA_OP Vec mul(Vec a, Vec b) { return a * b; }
NMA_OP Vec fma(Vec a, Vec b, Vec c) { return a * b + c; }
NMA_OP Vec max(Vec a, Vec b) { return detail::most(a, b); }
NMA_OP Vec min(Vec a, Vec b) { return detail::least(a, b); }
NMA_OP Vec nearest(Vec x) { return __builtin_convertvector(detail::nearest(x), Vec); }
NMA_OP Vec inverse(Vec a) { return 1.0f / a; }
NMA_OP Vec scale(Vec a, Vec whole) { return a * (Vec)((__builtin_convertvector(whole, detail::Whole) + 127) << 23); }
#else
NMA_OP Vec add(Vec a, Vec b) {
    return each([&](int k) { return a[k] + b[k]; });
}
NMA_OP Vec sub(Vec a, Vec b) {
    return each([&](int k) { return a[k] - b[k]; });
}
NMA_OP Vec mul(Vec a, Vec b) {
    return each([&](int k) { return a[k] * b[k]; });
}
NMA_OP Vec fma(Vec a, Vec b, Vec c) {
    return each([&](int k) { return a[k] * b[k] + c[k]; });
}
NMA_OP Vec max(Vec a, Vec b) {
    return each([&](int k) { return a[k] > b[k] ? a[k] : b[k]; });
}
NMA_OP Vec min(Vec a, Vec b) {
    return each([&](int k) { return a[k] < b[k] ? a[k] : b[k]; });
}
NMA_OP Vec nearest(Vec x) {
    return each([&](int k) { return static_cast<float>(static_cast<int>(x[k] + (x[k] < 0.0f ? -0.5f : 0.5f))); });
}
NMA_OP Vec inverse(Vec a) {
    return each([&](int k) { return 1.0f / a[k]; });
}
NMA_OP Vec scale(Vec a, Vec whole) {
    return mul(
        a, each([&](int k) { return from_bits(static_cast<std::uint32_t>(static_cast<int>(whole[k]) + 127) << 23); }));
}
#endif
NMA_OP Vec even(const std::uint32_t* pairs) {
    return each([&](int k) { return from_bits(pairs[k] << 16); });
}
NMA_OP Vec odd(const std::uint32_t* pairs) {
    return each([&](int k) { return from_bits(pairs[k] & 0xffff0000u); });
}

using Few = Indexed;  // in memory

#include "body.inl"

}  // namespace nma::portable

#undef NMA_FN
#undef NMA_OP
