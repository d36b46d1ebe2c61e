// A network as the kernels see it: its weights in memory, in the order in which the kernels read them.
//
// `Network` (network.h) fills in the first two structures, `Adapter` (nma.h) the third. Vectors have 4, 8 or 16 lanes,
// depending on the instruction set. All widths here are multiples of 16, so that every instruction set reads the same
// layout.
#pragma once

#include <cstdint>

namespace nma {

// The largest number of inputs or outputs of a layer. Buffers of this size lie on the stack.
constexpr int WIDEST_LAYER = 512;
// The largest number of layers, including the output layer.
constexpr int DEEPEST_NETWORK = 16;
// Widths are multiples of the lanes of the widest vector. Counts of inputs are multiples of the inputs that the inner
// loop of a kernel takes per step.
constexpr int WIDTH_STEP = 16, INPUT_STEP = 4;
// The width of a narrow network. Its activations fit in two vectors of 16 lanes and stay in registers.
constexpr int NARROW = 32;

// A layer maps `in` inputs to `width` neurons. Both counts include the padding, and the weights of the padding are 0.
// Either `columns` or `pairs` is set, never both:
//
//     columns  [in][width]      floats. Column i holds what input i adds to each neuron.
//     pairs    [in / 2][width]  two weights as bfloat16 in 32 bits: input 2 i in the low half, input 2 i + 1 in the
//                               high half. This halves the memory, which a single query waits for.
//     turned   [in][width]      the floats of `columns` in another order. Narrow networks on AVX-512 have it in
//                               addition to `columns`, for single queries.
//
// Why `turned`: each step of `columns` multiplies column i by a vector that repeats input i in all its lanes. If the
// inputs lie in a register, that takes one shuffle per input. Each step of `turned` multiplies by a vector that repeats
// four inputs in the order in which they lie. One shuffle then serves four inputs. Here are four inputs and four
// neurons; 2>3 is the weight from input 2 to neuron 3:
//
//     `columns`         neuron 0    1    2    3         `turned`            lane 0    1    2    3    adds to sum
//     column 0, times x0     0>0  0>1  0>2  0>3         r = 0, times x0..x3    0>0  1>1  2>2  3>3    0
//     column 1, times x1     1>0  1>1  1>2  1>3         r = 1, times x0..x3    0>1  1>2  2>3  3>0    1
//     column 2, times x2     2>0  2>1  2>2  2>3         r = 2, times x0..x3    0>2  1>3  2>0  3>1    2
//     column 3, times x3     3>0  3>1  3>2  3>3         r = 3, times x0..x3    0>3  1>0  2>1  3>2    3
//
// Lane k of sum r belongs to neuron (k + r) % 4. So sum r is turned once, r lanes to the right, after all inputs were
// added. The four turned sums, added up, are the neurons. A layer has many such squares of 4 x 4 weights: square (b, g)
// goes from the inputs 4 b .. 4 b + 3 to the neurons 4 g .. 4 g + 3. Row r of square (b, g) lies in column 4 b + r, at
// the places 4 g .. 4 g + 3. The columns of the first WIDTH_STEP neurons come first, then those of the next WIDTH_STEP.
struct LayerView {
    int in, width;
    const float* bias;
    const float *columns, *turned;
    const std::uint32_t* pairs;
};

struct NetworkView {
    int depth;    // count of layers
    bool narrow;  // whether all layers are NARROW wide and have `turned`
    LayerView layers[DEEPEST_NETWORK];
};

// How a kernel decodes outputs. Output k has the sigmoid u and the decoded value
//
//     start[k] + slope[k] u + factor[k] 2^(rate[k] u)
//
// Where in_plane[k] is 1 rather than 0, that value is multiplied by sin^2(theta_i), which fades towards normal
// incidence. The arrays have `count` numbers, a multiple of WIDTH_STEP, with zeros after the last output. At least one
// such zero output exists. From index `logarithmic` on all factors are 0.
struct Ranges {
    int count, logarithmic;
    const float *start, *slope, *factor, *rate, *in_plane;
};

}  // namespace nma
