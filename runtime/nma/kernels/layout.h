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
// Room for the outputs of queries that `forward_many` works on together.
constexpr int MOST_TOGETHER = 8;

// A layer. Column i of the matrix holds what input i adds to each neuron. Either `columns` is set, floats; or `pairs`,
// where each number holds the weights of inputs 2 i (low half) and 2 i + 1 (high half) as bfloat16: half the memory,
// which is what a single query waits for.
struct LayerView {
    int in, width;  // padded with zeros
    const float* bias;
    const float* columns;
    const std::uint32_t* pairs;
};

struct NetworkView {
    int depth;
    LayerView layers[DEEPEST_NETWORK];
};

// Numbers that a network's outputs become: low + span u or low exp(span u) of their sigmoid u, and those `in_plane`
// times the fade towards normal incidence. All padded to `count`, a multiple of WIDTH_STEP.
struct Ranges {
    int count;
    bool any_log;
    const float *low, *span, *log, *in_plane;  // `log` and `in_plane` hold 1 or 0
};

}  // namespace nma
