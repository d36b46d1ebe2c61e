// x86-64 with AVX512-BF16. In each lane, one instruction multiplies two inputs by two weights and adds the two products
// to a sum. Inputs and activations are rounded to bfloat16, which keeps 8 significant bits. Sums are float32. Layers
// must have `LayerView::pairs`.
//
// Only the code of the network differs from avx512.h, whose `encode`, `decode` and `set_lobe_probabilities` are used
// here, too.
#pragma once

#include <cstring>

#include "avx512.h"

#define NMA_FN NMA_TARGET("avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")
#define NMA_OP NMA_FN NMA_INLINE

namespace nma::avx512_bf16 {

using avx512::Vec;
using avx512::VEC_SIZE;

// Computes VECTORS vectors of neurons for QUERIES queries. `first` is the index of the first of these neurons. `x`
// holds the inputs in pairs. `tile` in body.inl is the version for float32.
template <int VECTORS, int QUERIES, int SUMS>
NMA_FN inline void tile(const LayerView& layer, int first, const std::uint32_t* x, int x_stride, float* y,
                        int y_stride) {
    Vec sums[SUMS][QUERIES][VECTORS];
    NMA_UNROLL for (int q = 0; q < QUERIES; ++q) NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
        sums[0][q][v] = _mm512_load_ps(layer.bias + first + v * VEC_SIZE);
        NMA_UNROLL for (int s = 1; s < SUMS; ++s) sums[s][q][v] = _mm512_setzero_ps();
    }
    const std::uint32_t* pair = layer.pairs + first;
    for (int i = 0; i < layer.in / 2; i += 2) {
        NMA_UNROLL for (int k = 0; k < 2; ++k) {
            __m512i weights[VECTORS];
            NMA_UNROLL for (int v = 0; v < VECTORS; ++v) weights[v] = _mm512_load_si512(pair + v * VEC_SIZE);
            NMA_UNROLL for (int q = 0; q < QUERIES; ++q) {
                const __m512i input = _mm512_set1_epi32(static_cast<int>(x[q * x_stride + i + k]));
                NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
                    Vec& sum = sums[k % SUMS][q][v];
                    sum = _mm512_dpbf16_ps(sum, (__m512bh)input, (__m512bh)weights[v]);
                }
            }
            pair += layer.width;
        }
    }
    NMA_UNROLL for (int q = 0; q < QUERIES; ++q) NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
        Vec sum = sums[0][q][v];
        NMA_UNROLL for (int s = 1; s < SUMS; ++s) sum = _mm512_add_ps(sum, sums[s][q][v]);
        _mm512_store_ps(y + q * y_stride + first + v * VEC_SIZE, sum);
    }
}

template <int VECTORS, int QUERIES>
NMA_FN inline void tiles(const LayerView& layer, int first, const std::uint32_t* x, int x_stride, float* y,
                         int y_stride) {
    constexpr int SUMS = QUERIES > 1 ? 1 : 2;
    for (; first + VECTORS * VEC_SIZE <= layer.width; first += VECTORS * VEC_SIZE)
        tile<VECTORS, QUERIES, SUMS>(layer, first, x, x_stride, y, y_stride);
    if constexpr (VECTORS > 1)
        if (first < layer.width) tiles<VECTORS / 2, QUERIES>(layer, first, x, x_stride, y, y_stride);
}

// Stores sixteen floats as eight pairs of bfloat16, rounded to nearest.
NMA_OP void store_pairs(std::uint32_t* pairs, Vec v) {
    _mm256_store_si256(reinterpret_cast<__m256i*>(pairs), (__m256i)_mm512_cvtneps_pbh(v));
}

// Stores the inputs of QUERIES queries as pairs. `x` has a row of STRIDE pairs for each query.
template <int QUERIES, int STRIDE>
NMA_FN inline void store_inputs(const NetworkView& view, const float* inputs, int input_stride, std::uint32_t* x) {
    const int count = view.layers[0].in;
    for (int q = 0; q < QUERIES; ++q)
        for (int i = 0; i < count; i += VEC_SIZE) {
            const __mmask16 present = static_cast<__mmask16>(count - i >= VEC_SIZE ? 0xffff : (1 << (count - i)) - 1);
            store_pairs(x + q * STRIDE + i / 2, _mm512_maskz_loadu_ps(present, inputs + q * input_stride + i));
        }
}

template <int QUERIES>
NMA_FN inline void run_layers(const NetworkView& view, const float* inputs, int input_stride, float* outputs,
                              int output_stride) {
    alignas(64) float y[QUERIES * WIDEST_LAYER];
    alignas(64) std::uint32_t x[QUERIES * WIDEST_LAYER / 2];
    constexpr int STRIDE = WIDEST_LAYER / 2;
    store_inputs<QUERIES, STRIDE>(view, inputs, input_stride, x);
    for (int k = 0; k < view.depth; ++k) {
        const LayerView& layer = view.layers[k];
        if (k + 1 == view.depth) return tiles<4, QUERIES>(layer, 0, x, STRIDE, outputs, output_stride);
        tiles<4, QUERIES>(layer, 0, x, STRIDE, y, layer.width);
        // If the next layer reads the inputs of the network, too, they come before the neurons of this layer.
        const int before = view.layers[k + 1].in - layer.width;
        if (before) store_inputs<QUERIES, STRIDE>(view, inputs, input_stride, x);
        for (int q = 0; q < QUERIES; ++q)
            for (int j = 0; j < layer.width; j += VEC_SIZE)
                store_pairs(x + q * STRIDE + (before + j) / 2,
                            avx512::max(avx512::load(y + q * layer.width + j), avx512::set(0.0f)));
    }
}

NMA_FN inline void forward(const NetworkView& view, const float* inputs, float* outputs) {
    run_layers<1>(view, inputs, 0, outputs, 0);
}

NMA_FN inline void forward_many(const NetworkView& view, int queries, const float* inputs, int input_stride,
                                float* outputs, int output_stride) {
    int q = 0;
    for (; q + 6 <= queries; q += 6)
        run_layers<6>(view, inputs + q * input_stride, input_stride, outputs + q * output_stride, output_stride);
    for (; q < queries; ++q) forward(view, inputs + q * input_stride, outputs + q * output_stride);
}

}  // namespace nma::avx512_bf16

#undef NMA_FN
#undef NMA_OP
