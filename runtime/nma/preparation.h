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
    // The same for the first two lanes of the first pack, which are enough for a blend of one or two instances. With
    // `outputs_of_lanes` for both, GCC computes the addresses of all lanes before it knows which of them are needed.
    const int* outputs_of_pairs;
    // The indices of the interface's width and index of refraction in the parameters; null if the target does not lie
    // under an interface.
    const int* interface;
    // The parameters of the single material that the adapter was fitted to, or null.
    const float* material;
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
    // Reads two numbers. The last two lanes hold no instance.
    Lanes<float> pair(const int* index) const { return {numbers[index[0]], numbers[index[1]], 0.0f, 0.0f}; }
};

// Fills in all numbers of the instances of a pack. `read` reads the lanes of one number at an index of an array that
// has STEP indices for each number.
template <int STEP, class Read>
inline void fill_instances(Pack<float>& pack, const int* index, const Read& read) {
    NMA_UNROLL for (int f = 0; f < Blend<float>::PRINCIPLED_SIZE; ++f) pack.as_array()[f] = read(index + f * STEP);
}

// Fills in the interface above a blend, if there is one. If the adapter was fitted to a single material, `parameters`
// is not read.
inline void set_interface(const Preparation& preparation, const float* parameters, Blend<float>& blend) {
    const int* at = preparation.interface;
    blend.under_interface = at != nullptr;
    if (!at) return;
    const float* row = preparation.material ? preparation.material : parameters;
    blend.interface = {row[at[0]], row[at[1]]};
}

// Fills in the interface, the instances and the weights of a blend. `numbers` holds the decoded outputs. `pick` is an
// `Indexed` or a `Few` that reads the same numbers.
template <class Pick>
inline void assemble(const Preparation& preparation, const float* parameters, const float* numbers, const Pick& pick,
                     Blend<float>& blend) {
    blend.count = preparation.instances;
    blend.scale = {1.0f, 1.0f, 1.0f};
    set_interface(preparation, parameters, blend);
    const float* share = numbers + preparation.outputs - (blend.count - 1);
    float left = 1.0f;
    for (int n = 0; n < blend.used(); ++n) {
        Pack<float>& pack = blend.packs[n];
        const int* index = preparation.outputs_of_lanes + n * Blend<float>::PRINCIPLED_SIZE * LANES;
        if (Pick::MOST > 0 || blend.count > 2) fill_instances<LANES>(pack, index, pick);
        else
            fill_instances<2>(pack, preparation.outputs_of_pairs,
                              [&](const int* k) { return Indexed(numbers).pair(k); });
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
