// How kernels see a network: its weights in memory, in the order in which they are read.
#pragma once

#include <cstdint>

namespace nma {

// Layers of at most this many inputs and outputs run; their numbers live on the stack.
constexpr int WIDEST_LAYER = 512;
// Networks of at most this many layers, the last one included.
constexpr int DEEPEST_NETWORK = 16;
// Widths are multiples of the widest vector, numbers of inputs multiples of the inputs that a step takes.
constexpr int WIDTH_STEP = 16, INPUT_STEP = 4;
// Width of networks whose activations stay in registers where there are enough.
constexpr int NARROW = 32;
// Room for the outputs of queries that `forward_many` works on together.
constexpr int MOST_TOGETHER = 8;

// A layer. Column i of the matrix holds what input i adds to each neuron. Either `columns` is set, floats; or `pairs`,
// where each number holds the weights of inputs 2 i (low half) and 2 i + 1 (high half) as bfloat16: half the memory,
// which is what a single query waits for.
//
// Narrow networks have `turned` too, for single queries on AVX-512: it takes four inputs at once as they lie, again and
// again: column 4 b + r holds, at neuron 4 g + k, what input 4 b + k adds to neuron 4 g + (k + r) % 4. The sum over all
// b is turned by r once, at its end. All columns of the first WIDTH_STEP neurons come first, then those of the next.
struct LayerView {
    int in, width;  // padded with zeros
    const float* bias;
    const float *columns, *turned;
    const std::uint32_t* pairs;
};

struct NetworkView {
    int depth;
    bool narrow;  // all layers are NARROW wide, and have `turned`
    LayerView layers[DEEPEST_NETWORK];
};

// Numbers that a network's outputs become, of their sigmoids u: start + slope u + factor 2^(rate u), and those
// `in_plane` times the fade towards normal incidence. All padded with zeros to `count`, a multiple of WIDTH_STEP that
// leaves room for at least one of them; from `logarithmic` on all factors are 0.
struct Ranges {
    int count, logarithmic;
    const float *start, *slope, *factor, *rate, *in_plane;  // `in_plane` holds 1 or 0
};

}  // namespace nma
