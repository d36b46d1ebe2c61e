// The data that all steps of `Adapter::prepare` read, and `assemble`, a step whose code all instruction sets share.
#pragma once

#include "blend.h"
#include "encoding.h"
#include "kernels/layout.h"
#include "kernels/macros.h"

namespace nma {

// The data of an adapter that `prepare` reads. An `Adapter` owns the arrays that the pointers in this structure point
// to.
struct Preparation {
    Encoding encoding;
    NetworkView network;
    Ranges ranges;
    int instances, outputs;  // counts
    bool bounded;            // whether the blend is scaled so that it reflects no more light than it receives
    // For each lane of each field of each pack, in the order of `Pack` in memory: the index of the decoded output that
    // the lane holds. A lane that holds no output has the index of an output of padding, whose value is 0.
    const int* outputs_of_lanes;
};

// Reads the numbers of four lanes from memory by their indices. `LANES` is the count of lanes of `Lanes` and `Pack`,
// which is 4 for every instruction set.
//
// `Few` (kernels/avx512.h) has the same call operator, but reads from registers, which hold at most `Few::MOST`
// numbers. For the other instruction sets, `Few` is another name of `Indexed`.
struct Indexed {
    static constexpr int MOST = 0;
    const float* numbers;

    explicit Indexed(const float* all) : numbers(all) {}
    Lanes<float> operator()(const int* index) const {
        return {numbers[index[0]], numbers[index[1]], numbers[index[2]], numbers[index[3]]};
    }
};

// Fills in the instances and the weights of a blend. `numbers` holds the decoded outputs. `pick` is an `Indexed` or a
// `Few` that reads the same numbers.
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
