// x86-64 with AVX-512 F, BW, DQ and VL: sixteen lanes, 32 registers.
//
// After the common functions of body.inl, this file has functions for narrow networks, whose activations stay in
// registers. These functions read `LayerView::diagonals`, which layout.h explains.
#pragma once

#include <cstring>
#include <immintrin.h>

#include "../preparation.h"
#include "macros.h"

#define NMA_FN NMA_TARGET("avx512f,avx512bw,avx512dq,avx512vl,fma")
#define NMA_OP NMA_FN NMA_INLINE

namespace nma::avx512 {

constexpr int VEC_SIZE = 16, SINGLE_TILE = 4, BATCH_TILE = 4, BATCH_QUERIES = 6;

using Vec = __m512;

// The mask of all lanes. This file uses masked intrinsics, because intrinsics without a mask make GCC 12 warn about its
// own headers (bug 105593).
constexpr __mmask16 ALL = 0xffff;

NMA_OP Vec load(const float* p) { return _mm512_load_ps(p); }
NMA_OP void store(float* p, Vec v) { _mm512_store_ps(p, v); }
NMA_OP Vec set(float x) { return _mm512_set1_ps(x); }
NMA_OP Vec add(Vec a, Vec b) { return _mm512_add_ps(a, b); }
NMA_OP Vec sub(Vec a, Vec b) { return _mm512_sub_ps(a, b); }
NMA_OP Vec mul(Vec a, Vec b) { return _mm512_mul_ps(a, b); }
NMA_OP Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a, b, c); }
// The instruction `rcp14` estimates 1 / a with 14 correct bits, and one Newton step doubles the count of correct bits.
// A division would take twice as long as the estimate and the Newton step.
NMA_OP Vec inverse(Vec a) {
    const Vec near = _mm512_maskz_rcp14_ps(ALL, a);
    return fma(near, _mm512_fnmadd_ps(a, near, set(1.0f)), near);
}
NMA_OP Vec max(Vec a, Vec b) { return _mm512_maskz_max_ps(ALL, a, b); }
NMA_OP Vec min(Vec a, Vec b) { return _mm512_maskz_min_ps(ALL, a, b); }
NMA_OP Vec nearest(Vec x) { return _mm512_maskz_roundscale_ps(ALL, x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
NMA_OP Vec scale(Vec a, Vec whole) { return _mm512_maskz_scalef_ps(ALL, a, whole); }
NMA_OP __m512i raw(const std::uint32_t* pairs) { return _mm512_load_si512(pairs); }
NMA_OP Vec even(const std::uint32_t* pairs) {
    return _mm512_castsi512_ps(_mm512_maskz_slli_epi32(ALL, raw(pairs), 16));
}
NMA_OP Vec odd(const std::uint32_t* pairs) {
    return _mm512_castsi512_ps(_mm512_and_si512(raw(pairs), _mm512_set1_epi32(-65536)));
}

// A version of `Indexed` (preparation.h) for at most 32 numbers, which are in two registers instead of memory. A call
// reads four indices, and returns the numbers at these indices.
struct Few {
    static constexpr int MOST = 2 * VEC_SIZE;
    Vec low, high;

    NMA_FN Few(Vec a, Vec b) : low(a), high(b) {}
    NMA_FN explicit Few(const float* all) : Few(load(all), load(all + VEC_SIZE)) {}
    NMA_FN nma::Lanes<float> operator()(const int* index) const {
        const __m512i four = _mm512_castsi128_si512(_mm_loadu_si128(reinterpret_cast<const __m128i*>(index)));
        const __m128 numbers = _mm512_maskz_extractf32x4_ps(0xf, _mm512_permutex2var_ps(low, four, high), 0);
        nma::Lanes<float> found;
        std::memcpy(&found, &numbers, sizeof(found));
        return found;
    }
};

#include "body.inl"

// The functions below treat a vector as four blocks of four lanes each. `repeat(p)` copies the four numbers at `p` into
// all blocks, and `repeat<B>(v)` copies block B of `v` into all blocks.
NMA_OP Vec repeat(const float* p) { return _mm512_maskz_broadcast_f32x4(ALL, _mm_loadu_ps(p)); }
template <int B>
NMA_OP Vec repeat(Vec v) {
    return _mm512_maskz_shuffle_f32x4(ALL, v, v, B * 0x55);
}
// Rotates the lanes of each block: the number in lane k moves to lane (k + R) % 4.
template <int R>
NMA_OP Vec rotate(Vec v) {
    return _mm512_maskz_permute_ps(ALL, v, R == 1 ? 0x93 : 0x4e);
}

// Adds the contributions of four inputs to the sums of 16 neurons. `inputs` repeats the four inputs in all blocks.
// `columns` points to the four columns of `LayerView::diagonals` for these inputs.
NMA_OP void add_block(Vec (&sums)[4], Vec inputs, const float* columns) {
    NMA_UNROLL for (int r = 0; r < 4; ++r) sums[r] = fma(inputs, load(columns + r * VEC_SIZE), sums[r]);
}
// The values of 16 neurons: rotates sums[r] by r lanes, and adds up the four rotated sums.
NMA_OP Vec total(const Vec (&sums)[4]) {
    return add(add(sums[0], rotate<1>(sums[1])), rotate<2>(add(sums[2], rotate<1>(sums[3]))));
}

// Computes the first layer, whose inputs are in memory. The layer has NARROW neurons, which fill the two vectors `y`.
NMA_OP void first_layer(const LayerView& layer, const float* x, Vec (&y)[2]) {
    NMA_UNROLL for (int v = 0; v < 2; ++v) {
        const float* column = layer.diagonals + v * layer.in * VEC_SIZE;
        Vec sums[4] = {load(layer.bias + v * VEC_SIZE), set(0.0f), set(0.0f), set(0.0f)};
        for (int i = 0; i < layer.in; i += 4) add_block(sums, repeat(x + i), column + i * VEC_SIZE);
        y[v] = total(sums);
    }
}
// Computes a layer after the first. On entry, `y` holds the neurons of the previous layer. On return, `y` holds the
// neurons of this layer. `x` holds the inputs of the network, which the last layer may read.
NMA_OP void next_layer(const LayerView& layer, const float* x, Vec (&y)[2]) {
    const Vec a = max(y[0], set(0.0f)), b = max(y[1], set(0.0f));
    const Vec blocks[] = {repeat<0>(a), repeat<1>(a), repeat<2>(a), repeat<3>(a),
                          repeat<0>(b), repeat<1>(b), repeat<2>(b), repeat<3>(b)};
    NMA_UNROLL for (int v = 0; v < 2; ++v) {
        const float* column = layer.diagonals + v * layer.in * VEC_SIZE;
        Vec sums[4] = {load(layer.bias + v * VEC_SIZE), set(0.0f), set(0.0f), set(0.0f)};
        for (int i = 0; i < layer.in - NARROW; i += 4, column += 4 * VEC_SIZE) add_block(sums, repeat(x + i), column);
        NMA_UNROLL for (int k = 0; k < 8; ++k) add_block(sums, blocks[k], column + 4 * k * VEC_SIZE);
        y[v] = total(sums);
    }
}

// Computes all layers of a narrow network.
NMA_OP void run_narrow(const NetworkView& view, const float* inputs, Vec (&y)[2]) {
    first_layer(view.layers[0], inputs, y);
    for (int k = 1; k < view.depth; ++k) next_layer(view.layers[k], inputs, y);
}

// The function `forward` of `Kernels`, for networks of any width. For a narrow network, `run_narrow` keeps the
// activations in registers; any other network runs in the function `forward` of body.inl.
NMA_FN inline void forward_any(const NetworkView& view, const float* inputs, float* outputs) {
    if (!view.narrow) return forward(view, inputs, outputs);
    Vec y[2];
    run_narrow(view, inputs, y);
    store(outputs, y[0]);
    store(outputs + VEC_SIZE, y[1]);
}

NMA_FN NMA_WHOLE inline void prepare_narrow(const Preparation& preparation, const float* parameters,
                                            const Vec3<float>& wi, Blend<float>& blend) {
    alignas(64) float inputs[WIDEST_LAYER], numbers[NARROW];
    Vec y[2];
    encode(preparation, parameters, wi, inputs);
    run_narrow(preparation.network, inputs, y);
    NMA_UNROLL for (int v = 0; v < 2; ++v) {
        y[v] = decoded(preparation.ranges, v * VEC_SIZE, y[v], 1.0f - wi.z * wi.z);
        store(numbers + v * VEC_SIZE, y[v]);
    }
    assemble(preparation, parameters, numbers, Few(y[0], y[1]), blend);
    nma::set_lobe_probabilities(blend, wi.z, preparation.bounded);
}

// The function `prepare` of `Kernels`, for networks of any width.
NMA_FN inline void prepare_any(const Preparation& preparation, const float* parameters, const Vec3<float>& wi,
                               Blend<float>& blend) {
    if (preparation.network.narrow) return prepare_narrow(preparation, parameters, wi, blend);
    prepare<forward>(preparation, parameters, wi, blend);
}

}  // namespace nma::avx512

#undef NMA_FN
#undef NMA_OP
