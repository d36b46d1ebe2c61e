// The weights of a network in memory, in the order in which the functions in kernels/ read them.
//
// `Network` (network.h) fills in `LayerView` and `NetworkView`, and `Adapter` (nma.h) fills in `Ranges`. Vectors have
// 4, 8 or 16 lanes, depending on the instruction set. All widths in this file are multiples of 16, so that every
// instruction set reads the same layout.
#pragma once

#include <cstdint>

namespace nma {

// The largest count of inputs or outputs of a layer. Buffers of this size are on the stack.
constexpr int WIDEST_LAYER = 512;
// The largest count of layers, including the output layer.
constexpr int DEEPEST_NETWORK = 16;
// WIDTH_STEP is the count of lanes of the widest vector, and every width is a multiple of it. INPUT_STEP is the count
// of inputs that the inner loop of `tile` (body.inl) reads per step, and every count of inputs is a multiple of it.
constexpr int WIDTH_STEP = 16, INPUT_STEP = 4;
// The width of a narrow network. The activations of such a network fit in two vectors of 16 lanes and stay in
// registers.
constexpr int NARROW = 32;

// A layer maps `in` inputs to `width` neurons. `in` and `width` include the padding, whose weights are 0. A layer has
// either `columns` or `pairs`:
//
//     columns  [in][width]      floats. Column i holds the weights from input i to all neurons.
//     pairs    [in / 2][width]  two weights as bfloat16 in 32 bits: the weight from input 2 i in the low half, and the
//                               weight from input 2 i + 1 in the high half. A single query waits for the memory of
//                               the weights, which `pairs` halves.
//     turned   [in][width]      the floats of `columns` in another order, for single queries on AVX-512. Narrow
//                               networks have it in addition to `columns`.
//
// `turned` needs fewer shuffle instructions than `columns` if the inputs are in a register. Each step of `columns`
// multiplies column i by a vector that repeats input i in all its lanes, which takes one shuffle per input. Each step
// of `turned` multiplies a column by a vector that repeats four inputs in their order, which takes one shuffle per four
// inputs. The following example has four inputs x0 .. x3 and four neurons, and 2>3 is the weight from input 2 to neuron
// 3:
//
//     `columns`         neuron 0    1    2    3         `turned`            lane 0    1    2    3    adds to sum
//     column 0, times x0     0>0  0>1  0>2  0>3         r = 0, times x0..x3    0>0  1>1  2>2  3>3    0
//     column 1, times x1     1>0  1>1  1>2  1>3         r = 1, times x0..x3    0>1  1>2  2>3  3>0    1
//     column 2, times x2     2>0  2>1  2>2  2>3         r = 2, times x0..x3    0>2  1>3  2>0  3>1    2
//     column 3, times x3     3>0  3>1  3>2  3>3         r = 3, times x0..x3    0>3  1>0  2>1  3>2    3
//
// Lane k of sum r belongs to neuron (k + r) % 4. Therefore sum r is rotated once, by r lanes to the right, after the
// products of all inputs were added to it. The neurons are the total of the four rotated sums. The weights of a layer
// are divided into squares of 4 x 4 weights. Square (b, g) has the weights from the inputs 4 b .. 4 b + 3 to the
// neurons 4 g .. 4 g + 3. Row r of square (b, g) is in column 4 b + r of `turned`, at the elements 4 g .. 4 g + 3. In
// memory, the columns of the first WIDTH_STEP neurons are followed by the columns of the next WIDTH_STEP neurons.
struct LayerView {
    int in, width;
    const float* bias;
    const float *columns, *turned;
    const std::uint32_t* pairs;
};

struct NetworkView {
    int depth;    // count of layers
    bool narrow;  // whether all layers have the width NARROW, and have `turned`
    LayerView layers[DEEPEST_NETWORK];
};

// The constants for decoding outputs. If u is the sigmoid of output k, the decoded value of this output is
//
//     start[k] + slope[k] u + factor[k] 2^(rate[k] u)
//
// If in_plane[k] is 1 instead of 0, the decoded value is multiplied by sin^2(theta_i), which goes to 0 towards normal
// incidence. The arrays have `count` numbers, a multiple of WIDTH_STEP. After the last output of the network, the
// arrays have at least one zero. From index `logarithmic` on, all factors are 0.
struct Ranges {
    int count, logarithmic;
    const float *start, *slope, *factor, *rate, *in_plane;
};

}  // namespace nma
