// The data that the kernels of `Adapter::prepare` read, and the step of `prepare` that is written once for all
// instruction sets.
#pragma once

#include "blend.h"
#include "encoding.h"
#include "kernels/layout.h"
#include "kernels/macros.h"

namespace nma {

// Its pointers are to arrays that an `Adapter` owns.
struct Preparation {
    Encoding encoding;
    NetworkView network;
    Ranges ranges;
    int instances, outputs;  // counts
    bool bounded;            // whether the blend must not reflect more light than it receives
    // For each lane of each field of each pack: the index of its number among the decoded outputs. The order is that of
    // `Pack` in memory. A lane without a number has the index of an output of padding, whose value is 0.
    const int* outputs_of_lanes;
};

// Picks the numbers of four lanes from memory, by four indices. `LANES` is the count of lanes of `Lanes` and `Pack`, 4
// for every instruction set.
//
// `Few` (kernels/avx512.h) is its twin for at most `MOST` numbers, which it picks from registers. The other instruction
// sets have no such registers. There, `Few` is another name of `Indexed`.
struct Indexed {
    static constexpr int MOST = 0;
    const float* numbers;

    explicit Indexed(const float* all) : numbers(all) {}
    Lanes<float> operator()(const int* index) const {
        return {numbers[index[0]], numbers[index[1]], numbers[index[2]], numbers[index[3]]};
    }
};

// Fills in the instances and the weights of a blend. `numbers` holds the decoded outputs. `pick` is an `Indexed` or a
// `Few` over the same numbers.
template <class Pick>
inline void assemble(const Preparation& preparation, const float* numbers, const Pick& pick, Blend<float>& blend) {
    blend.count = preparation.instances;
    blend.scale = {1.0f, 1.0f, 1.0f};
    const int* index = preparation.outputs_of_lanes;
    const float* share = numbers + preparation.outputs - (blend.count - 1);
    float left = 1.0f;
    for (int n = 0; n < blend.used(); ++n) {
        Pack<float>& pack = blend.packs[n];
        NMA_UNROLL for (int f = 0; f < Blend<float>::PRINCIPLED_SIZE; ++f, index += LANES) pack.as_array()[f] =
            pick(index);
        float weights[LANES] = {};
        NMA_UNROLL for (int k = 0; k < LANES; ++k) {
            const int next = n * LANES + k + 1;
            if (next > blend.count) break;
            weights[k] = next < blend.count ? left * *share++ : left;
            left -= weights[k];
        }
        pack.weights = {weights[0], weights[1], weights[2], weights[3]};
    }
}

}  // namespace nma
