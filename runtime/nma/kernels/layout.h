// The weights of a network in memory, in the order in which the functions in kernels/ read them.
//
// `Network` (network.h) fills in `LayerView` and `NetworkView`, and `Adapter` (nma.h) fills in `Ranges`. Vectors have
// 4, 8 or 16 lanes, depending on the instruction set. All widths in this file are multiples of the count of lanes.
#pragma once

#include <cstdint>

namespace nma {

// The largest count of inputs or outputs of a layer. Functions allocate arrays of this length on the stack, so that a
// query allocates no heap memory.
constexpr int WIDEST_LAYER = 512;
// The largest count of layers, including the output layer.
constexpr int DEEPEST_NETWORK = 16;
// WIDTH_STEP is the count of lanes of the widest vector. Every width is a multiple of WIDTH_STEP, except that of the
// last layer, which is a multiple of the lanes of the instruction set's vectors. INPUT_STEP is the count of inputs that
// the inner loop of `tile` (body.inl) reads per step. Every count of inputs is a multiple of INPUT_STEP.
constexpr int WIDTH_STEP = 16, INPUT_STEP = 4;
// The width of a narrow network. The activations of such a network fit in two vectors of 16 lanes and stay in
// registers.
constexpr int NARROW = 32;

// A layer maps `in` inputs to `width` neurons. `in` and `width` include the padding, whose weights are 0. A layer has
// either `columns` or `pairs`:
//
//     columns    [in][width]      floats. Column i holds the weights from input i to all neurons.
//     pairs      [in / 2][width]  two weights as bfloat16 in 32 bits: the weight from input 2 i in the low half, and
//                                 the weight from input 2 i + 1 in the high half. `pairs` has half the bytes of
//                                 `columns`, which saves time, because a single query mostly waits for weights to be
//                                 read from memory.
//     diagonals  [in][width]      the weights of `columns` in another order, for single queries on AVX-512. Narrow
//                                 networks have `diagonals` in addition to `columns`.
//
// A product with `columns` needs one shuffle instruction for each input x_i. The instruction copies x_i to all lanes of
// a vector, by which column i is multiplied. If the inputs are already in registers, a product with `diagonals` needs
// only about a quarter of the shuffles: one shuffle repeats four inputs in a vector, by which four columns of
// `diagonals` are multiplied. In the following example of four inputs and four neurons, 2>3 is the weight from input 2
// to neuron 3. Each column of `diagonals` is a diagonal of the matrix on the left, continued at the other edge:
//
//     `columns`              neuron 0    1    2    3     `diagonals`              lane 0    1    2    3    is added to
//     column 0, times x0          0>0  0>1  0>2  0>3     column 0, times x0..x3      0>0  1>1  2>2  3>3    sum 0
//     column 1, times x1          1>0  1>1  1>2  1>3     column 1, times x0..x3      0>1  1>2  2>3  3>0    sum 1
//     column 2, times x2          2>0  2>1  2>2  2>3     column 2, times x0..x3      0>2  1>3  2>0  3>1    sum 2
//     column 3, times x3          3>0  3>1  3>2  3>3     column 3, times x0..x3      0>3  1>0  2>1  3>2    sum 3
//
// Lane k of sum r holds products for neuron (k + r) % 4. After the products of all inputs were added, sum r is rotated
// by r lanes to the right, so that lane j belongs to neuron j. Then the four rotated sums are added, which gives the
// values of the neurons.
//
// A larger matrix of weights is divided into squares of 4 x 4 weights. Square (b, g) contains the weights from the
// inputs 4 b .. 4 b + 3 to the neurons 4 g .. 4 g + 3. Diagonal r of square (b, g) is stored in column 4 b + r of
// `diagonals`, at the elements 4 g .. 4 g + 3. In memory, the elements 0 .. 15 of all columns come first, then the
// elements 16 .. 31 of all columns, and so on.
//
// The last layer may read the inputs of the network, too. Its inputs are then the inputs of the network and, after
// them, the neurons of the layer before, each with their padding. So `in` of the last layer exceeds `width` of the
// layer before by the padded count of the network's inputs, which is then a multiple of WIDTH_STEP. The inputs come
// first, because the CPU can multiply them while it still computes the neurons.
struct LayerView {
    int in, width;
    const float* bias;
    const float *columns, *diagonals;
    const std::uint32_t* pairs;
};

struct NetworkView {
    int depth;    // count of layers
    bool narrow;  // whether every layer has the padded width NARROW and the array `diagonals`
    LayerView layers[DEEPEST_NETWORK];
};

// The constants for decoding outputs. If u is the sigmoid of output k, the decoded value of this output is
//
//     start[k] + slope[k] u + factor[k] 2^(rate[k] u)
//
// If in_plane[k] is 1 instead of 0, the decoded value is multiplied by sin^2(theta_i), which goes to 0 towards normal
// incidence. The arrays have `count` numbers, the width of the last layer. After the last output of the network, the
// arrays have at least one zero. The numbers factor[k] are 0 for all k >= `logarithmic`. For these k, the decoding does
// not compute the power of 2.
struct Ranges {
    int count, logarithmic;
    const float *start, *slope, *factor, *rate, *in_plane;
};

}  // namespace nma
