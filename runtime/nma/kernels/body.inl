// The functions of `Kernels` (kernels.h), written with a vector type that each instruction set defines. portable.h,
// neon.h, avx2.h and avx512.h include this file inside their own namespaces, so it has no include guard, no namespace
// and no #include. Before the #include of this file, a header defines these names:
//
//     NMA_FN        macro: the attributes of a function for this instruction set
//     NMA_OP        macro: the same attributes, and the function is always inlined
//     Vec, VEC_SIZE the vector type, and its count of floats: 4, 8 or 16
//     load, store, set, add, sub, mul, max, min
//     fma           a b + c
//     inverse       1 / a
//     nearest       rounds to a whole number
//     scale         a 2^b for a whole number b
//     even, odd     the low and the high bfloat16 of each pair, as floats
//     SINGLE_TILE   vectors of neurons that a tile has for a single query
//     BATCH_TILE    vectors of neurons that a tile has for each query of a batch
//     BATCH_QUERIES queries that a tile of a batch has
//     Few           picks numbers for lanes, from registers if possible: see `Indexed` in preparation.h
//
// The members of `Kernels` point to the functions `forward`, `forward_many`, `encode`, `decode`,
// `set_lobe_probabilities` and `prepare` below. The other functions in this file are helpers of these six functions.
// Only for AVX-512, the members `forward` and `prepare` point to `forward_any` and `prepare_any` (avx512.h). These two
// functions call `forward` and `prepare` below, except for narrow networks.

// Computes VECTORS vectors of neurons for QUERIES queries. `first` is the index of the first of these neurons. Each
// neuron has SUMS partial sums, because each addition to a single sum would wait for the addition before it. PAIRS says
// whether the function reads the weights from `LayerView::pairs` instead of `LayerView::columns`.
template <int VECTORS, int QUERIES, int SUMS, bool PAIRS>
NMA_FN inline void tile(const LayerView& layer, int first, const float* x, int x_stride, float* y, int y_stride,
                        bool relu) {
    Vec sums[SUMS][QUERIES][VECTORS];
    NMA_UNROLL for (int q = 0; q < QUERIES; ++q) NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
        sums[0][q][v] = load(layer.bias + first + v * VEC_SIZE);
        NMA_UNROLL for (int s = 1; s < SUMS; ++s) sums[s][q][v] = set(0.0f);
    }
    const float* column = PAIRS ? nullptr : layer.columns + first;
    const std::uint32_t* pair = PAIRS ? layer.pairs + first : nullptr;
    for (int i = 0; i < layer.in; i += INPUT_STEP) {
        NMA_UNROLL for (int k = 0; k < INPUT_STEP; k += PAIRS ? 2 : 1) {
            if constexpr (PAIRS) {
                Vec weights[2][VECTORS];
                NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
                    weights[0][v] = even(pair + v * VEC_SIZE);
                    weights[1][v] = odd(pair + v * VEC_SIZE);
                }
                NMA_UNROLL for (int half = 0; half < 2; ++half) NMA_UNROLL for (int q = 0; q < QUERIES; ++q) {
                    const Vec input = set(x[q * x_stride + i + k + half]);
                    NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
                        Vec& sum = sums[(k + half) % SUMS][q][v];
                        sum = fma(input, weights[half][v], sum);
                    }
                }
                pair += layer.width;
            } else {
                Vec weights[VECTORS];
                NMA_UNROLL for (int v = 0; v < VECTORS; ++v) weights[v] = load(column + v * VEC_SIZE);
                NMA_UNROLL for (int q = 0; q < QUERIES; ++q) {
                    const Vec input = set(x[q * x_stride + i + k]);
                    NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
                        Vec& sum = sums[k % SUMS][q][v];
                        sum = fma(input, weights[v], sum);
                    }
                }
                column += layer.width;
            }
        }
    }
    NMA_UNROLL for (int q = 0; q < QUERIES; ++q) NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
        Vec sum = sums[0][q][v];
        NMA_UNROLL for (int s = 1; s < SUMS; ++s) sum = add(sum, sums[s][q][v]);
        store(y + q * y_stride + first + v * VEC_SIZE, relu ? max(sum, set(0.0f)) : sum);
    }
}

// Computes all neurons of a layer from index `first` on, in tiles of VECTORS vectors. If fewer neurons remain than a
// tile has, they are computed in smaller tiles.
template <int VECTORS, int QUERIES, bool PAIRS>
NMA_FN inline void tiles(const LayerView& layer, int first, const float* x, int x_stride, float* y, int y_stride,
                         bool relu) {
    constexpr int SUMS = QUERIES * VECTORS >= 8 ? 1 : QUERIES * VECTORS >= 4 ? 2 : 4;
    for (; first + VECTORS * VEC_SIZE <= layer.width; first += VECTORS * VEC_SIZE)
        tile<VECTORS, QUERIES, SUMS, PAIRS>(layer, first, x, x_stride, y, y_stride, relu);
    if constexpr (VECTORS > 1) {
        constexpr int FEWER = VECTORS > 4 ? 4 : VECTORS - 1;
        if (first < layer.width) tiles<FEWER, QUERIES, PAIRS>(layer, first, x, x_stride, y, y_stride, relu);
    }
}

// Computes all layers of a network for QUERIES queries.
template <int VECTORS, int QUERIES>
NMA_FN inline void run_layers(const NetworkView& view, const float* inputs, int input_stride, float* outputs,
                              int output_stride) {
    alignas(64) float buffers[2][QUERIES * WIDEST_LAYER];
    const float* x = inputs;
    int x_stride = input_stride;
    for (int k = 0; k < view.depth; ++k) {
        const LayerView& layer = view.layers[k];
        const bool last = k + 1 == view.depth;
        float* y = last ? outputs : buffers[k % 2];
        const int y_stride = last ? output_stride : view.layers[k + 1].in;
        // If the next layer reads the inputs of the network, too, they come before the neurons of this layer.
        const int before = last ? 0 : y_stride - layer.width;
        for (int i = 0; i < before; i += VEC_SIZE)
            NMA_UNROLL for (int q = 0; q < QUERIES; ++q)
                store(y + q * y_stride + i, load(inputs + q * input_stride + i));
        if (layer.pairs) tiles<VECTORS, QUERIES, true>(layer, 0, x, x_stride, y + before, y_stride, !last);
        else tiles<VECTORS, QUERIES, false>(layer, 0, x, x_stride, y + before, y_stride, !last);
        x = y;
        x_stride = y_stride;
    }
}

NMA_FN inline void forward(const NetworkView& view, const float* inputs, float* outputs) {
    run_layers<SINGLE_TILE, 1>(view, inputs, 0, outputs, 0);
}

NMA_FN inline void forward_many(const NetworkView& view, int queries, const float* inputs, int input_stride,
                                float* outputs, int output_stride) {
    int q = 0;
    for (; q + BATCH_QUERIES <= queries; q += BATCH_QUERIES)
        run_layers<BATCH_TILE, BATCH_QUERIES>(view, inputs + q * input_stride, input_stride,
                                              outputs + q * output_stride, output_stride);
    for (; q < queries; ++q) forward(view, inputs + q * input_stride, outputs + q * output_stride);
}

// 2^x for |x| <= 126, to two units in the last place. The result is 2^n times a power series in x - n, where n is the
// whole number nearest to x, so |x - n| is at most 1/2.
NMA_OP Vec exp2(Vec x) {
    const Vec n = nearest(x), r = sub(x, n), r2 = mul(r, r);
    const Vec low = fma(fma(r, set(0.0555041087f), set(0.240226507f)), r2, fma(r, set(0.693147181f), set(1.0f)));
    const Vec high =
        fma(fma(r, set(1.52527338e-5f), set(1.54035304e-4f)), r2, fma(r, set(1.33335581e-3f), set(9.61812911e-3f)));
    return scale(fma(high, mul(r2, r2), low), n);
}

// Decodes a vector of raw outputs by the formula at `Ranges` (layout.h). k is the index of the first of these outputs.
// `fade` is sin^2(theta_i). nma/target/decode.py is the Python version of this function.
NMA_OP Vec decoded(const Ranges& ranges, int k, Vec raw, float fade) {
    const Vec one = set(1.0f), faded = fma(load(ranges.in_plane + k), set(fade - 1.0f), one);
    const Vec x = max(min(mul(raw, set(-1.44269504f)), set(120.0f)), set(-120.0f));
    const Vec unit = inverse(add(one, exp2(x)));
    const Vec value = fma(mul(load(ranges.slope + k), faded), unit, mul(load(ranges.start + k), faded));
    return k < ranges.logarithmic
               ? fma(mul(load(ranges.factor + k), faded), exp2(mul(load(ranges.rate + k), unit)), value)
               : value;
}

NMA_FN NMA_WHOLE inline void encode(const Preparation& preparation, const float* parameters, const Vec3<float>& wi,
                                    float* inputs) {
    preparation.encoding.encode(parameters, wi, inputs, preparation.network.layers[0].in);
}

// Decodes the raw outputs in place, and fills in the blend except for its lobe probabilities and its `scale`.
NMA_FN NMA_WHOLE inline void decode(const Preparation& preparation, const float* parameters, float* raw, float cosine,
                                    Blend<float>& blend) {
    for (int k = 0; k < preparation.ranges.count; k += VEC_SIZE)
        store(raw + k, decoded(preparation.ranges, k, load(raw + k), 1.0f - cosine * cosine));
    if (preparation.ranges.count <= Few::MOST) assemble(preparation, parameters, raw, Few(raw), blend);
    else assemble(preparation, parameters, raw, Indexed(raw), blend);
}

// Fills in the lobe probabilities of a decoded blend. If the adapter is bounded, also fills in `scale`, the factor that
// keeps the blend from reflecting more light than it receives. Both results need the albedo bounds of the lobes, so
// one function computes both.
NMA_FN NMA_WHOLE inline void set_lobe_probabilities(const Preparation& preparation, float cosine, Blend<float>& blend) {
    nma::set_lobe_probabilities(blend, cosine, preparation.bounded);
}

// Runs all steps for one query. FORWARD is the function that runs the network.
template <void (*FORWARD)(const NetworkView&, const float*, float*)>
NMA_FN inline void prepare(const Preparation& preparation, const float* parameters, const Vec3<float>& wi,
                           Blend<float>& blend) {
    alignas(64) float inputs[WIDEST_LAYER], numbers[WIDEST_LAYER];
    encode(preparation, parameters, wi, inputs);
    FORWARD(preparation.network, inputs, numbers);
    decode(preparation, parameters, numbers, wi.z, blend);
    set_lobe_probabilities(preparation, wi.z, blend);
}
