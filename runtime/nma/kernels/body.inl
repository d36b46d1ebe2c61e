// The kernels, compiled once for each instruction set inside its namespace. No include guard: that is the point.
//
// Before it stand NMA_FN (attributes of a function for this instruction set), NMA_OP (the same, always inlined),
// NMA_UNROLL, Vec (LANES floats) with load, store, set, add, sub, mul, fma (a b + c), inverse (1 / a), max, min,
// nearest (round to whole), scale (a 2^whole), even and odd (floats from the low and high halves of a pair), and the
// sizes of tiles: SINGLE_TILE vectors of neurons for one query, BATCH_TILE vectors for each of BATCH_QUERIES.

// `VECTORS` vectors of neurons from `first` on, for QUERIES queries. A neuron's sum is kept as SUMS sums: in a single
// one each multiplication would wait for the one before it.
template <int VECTORS, int QUERIES, int SUMS, bool PAIRS>
NMA_FN inline void tile(const LayerView& layer, int first, const float* x, int x_stride, float* y, int y_stride,
                        bool relu) {
    Vec sums[SUMS][QUERIES][VECTORS];
    NMA_UNROLL for (int q = 0; q < QUERIES; ++q) NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
        sums[0][q][v] = load(layer.bias + first + v * LANES);
        NMA_UNROLL for (int s = 1; s < SUMS; ++s) sums[s][q][v] = set(0.0f);
    }
    const float* column = PAIRS ? nullptr : layer.columns + first;
    const std::uint32_t* pair = PAIRS ? layer.pairs + first : nullptr;
    for (int i = 0; i < layer.in; i += INPUT_STEP) {
        NMA_UNROLL for (int k = 0; k < INPUT_STEP; k += PAIRS ? 2 : 1) {
            if constexpr (PAIRS) {
                Vec weights[2][VECTORS];
                NMA_UNROLL for (int v = 0; v < VECTORS; ++v) {
                    weights[0][v] = even(pair + v * LANES);
                    weights[1][v] = odd(pair + v * LANES);
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
                NMA_UNROLL for (int v = 0; v < VECTORS; ++v) weights[v] = load(column + v * LANES);
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
        store(y + q * y_stride + first + v * LANES, relu ? max(sum, set(0.0f)) : sum);
    }
}

// All neurons of a layer in tiles of VECTORS, what is left in halves.
template <int VECTORS, int QUERIES, bool PAIRS>
NMA_FN inline void tiles(const LayerView& layer, int first, const float* x, int x_stride, float* y, int y_stride,
                         bool relu) {
    constexpr int SUMS = QUERIES > 1 || VECTORS >= 8 ? 1 : VECTORS >= 4 ? 2 : 4;
    for (; first + VECTORS * LANES <= layer.width; first += VECTORS * LANES)
        tile<VECTORS, QUERIES, SUMS, PAIRS>(layer, first, x, x_stride, y, y_stride, relu);
    if constexpr (VECTORS * LANES > WIDTH_STEP)
        if (first < layer.width) tiles<VECTORS / 2, QUERIES, PAIRS>(layer, first, x, x_stride, y, y_stride, relu);
}

template <int VECTORS, int QUERIES>
NMA_FN inline void network(const NetworkView& view, const float* x, int x_stride, float* outputs, int output_stride) {
    alignas(64) float buffers[2][QUERIES * WIDEST_LAYER];
    for (int k = 0; k < view.depth; ++k) {
        const LayerView& layer = view.layers[k];
        const bool last = k + 1 == view.depth;
        float* y = last ? outputs : buffers[k % 2];
        const int y_stride = last ? output_stride : layer.width;
        if (layer.pairs) tiles<VECTORS, QUERIES, true>(layer, 0, x, x_stride, y, y_stride, !last);
        else tiles<VECTORS, QUERIES, false>(layer, 0, x, x_stride, y, y_stride, !last);
        x = y;
        x_stride = y_stride;
    }
}

NMA_FN inline void forward(const NetworkView& view, const float* inputs, float* outputs) {
    network<SINGLE_TILE, 1>(view, inputs, 0, outputs, 0);
}

NMA_FN inline void forward_many(const NetworkView& view, int queries, const float* inputs, int input_stride,
                                float* outputs, int output_stride) {
    int q = 0;
    for (; q + BATCH_QUERIES <= queries; q += BATCH_QUERIES)
        network<BATCH_TILE, BATCH_QUERIES>(view, inputs + q * input_stride, input_stride, outputs + q * output_stride,
                                           output_stride);
    for (; q < queries; ++q) forward(view, inputs + q * input_stride, outputs + q * output_stride);
}

// 2^x for |x| <= 126 to two units in the last place: 2^n times the series of the rest, which is at most 1/2.
NMA_OP Vec exp2(Vec x) {
    const Vec n = nearest(x), r = sub(x, n), r2 = mul(r, r);
    const Vec low = fma(fma(r, set(0.0555041087f), set(0.240226507f)), r2, fma(r, set(0.693147181f), set(1.0f)));
    const Vec high =
        fma(fma(r, set(1.52527338e-5f), set(1.54035304e-4f)), r2, fma(r, set(1.33335581e-3f), set(9.61812911e-3f)));
    return scale(fma(high, mul(r2, r2), low), n);
}

// Raw outputs from number k on to numbers of the target. Twin of nma/target/decode.py.
NMA_OP Vec decoded(const Ranges& ranges, int k, Vec raw, float fade) {
    const Vec one = set(1.0f), faded = fma(load(ranges.in_plane + k), set(fade - 1.0f), one);
    const Vec x = max(min(mul(raw, set(-1.44269504f)), set(120.0f)), set(-120.0f));
    const Vec unit = inverse(add(one, exp2(x)));
    const Vec value = fma(mul(load(ranges.slope + k), faded), unit, mul(load(ranges.start + k), faded));
    if (k >= ranges.logarithmic) return value;
    return fma(mul(load(ranges.factor + k), faded), exp2(mul(load(ranges.rate + k), unit)), value);
}

NMA_FN NMA_WHOLE inline void encode(const Recipe& recipe, const float* parameters, const Vec3<float>& wi,
                                    float* inputs) {
    recipe.encoding.encode(parameters, wi, inputs, recipe.network.layers[0].in);
}

// The blend of a network's outputs, but for its odds; those of a blend.
NMA_FN NMA_WHOLE inline void decode(const Recipe& recipe, float* raw, float cosine, Blend<float>& blend) {
    for (int k = 0; k < recipe.ranges.count; k += LANES)
        store(raw + k, decoded(recipe.ranges, k, load(raw + k), 1.0f - cosine * cosine));
    if (recipe.ranges.count <= Few::MOST) assemble(recipe, raw, Few(raw), blend);
    else assemble(recipe, raw, Indexed(raw), blend);
}
NMA_FN NMA_WHOLE inline void odds(const Recipe& recipe, float cosine, Blend<float>& blend) {
    weigh(blend, cosine, recipe.bounded);
}

template <void (*FORWARD)(const NetworkView&, const float*, float*)>
NMA_FN inline void prepare(const Recipe& recipe, const float* parameters, const Vec3<float>& wi, Blend<float>& blend) {
    alignas(64) float inputs[WIDEST_LAYER], numbers[WIDEST_LAYER];
    encode(recipe, parameters, wi, inputs);
    FORWARD(recipe.network, inputs, numbers);
    decode(recipe, numbers, wi.z, blend);
    odds(recipe, wi.z, blend);
}
