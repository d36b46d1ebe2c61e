// What `Adapter::prepare` works with, and the step of it that is the same on every instruction set.
#pragma once

#include "blend.h"
#include "encoding.h"
#include "kernels/layout.h"
#include "kernels/macros.h"

namespace nma {

struct Recipe {
    Encoding encoding;
    NetworkView network;
    Ranges ranges;
    int instances, outputs;
    bool bounded;
    // The number that each lane of each field takes, of one pack after the other; lanes without one take one that is 0.
    const int* lanes;
};

// Numbers for lanes by their index.
struct Indexed {
    static constexpr int MOST = 0;
    const float* numbers;

    explicit Indexed(const float* all) : numbers(all) {}
    Lanes<float> operator()(const int* index) const {
        return {numbers[index[0]], numbers[index[1]], numbers[index[2]], numbers[index[3]]};
    }
};

// The instances and weights of a blend from their numbers, which `pick` brings to lanes.
template <class Pick>
inline void assemble(const Recipe& recipe, const float* numbers, const Pick& pick, Blend<float>& blend) {
    blend.count = recipe.instances;
    blend.scale = {1.0f, 1.0f, 1.0f};
    const int* index = recipe.lanes;
    const float* share = numbers + recipe.outputs - (blend.count - 1);
    float left = 1.0f;
    for (int n = 0; n < blend.used(); ++n) {
        Pack<float>& pack = blend.packs[n];
        NMA_UNROLL for (int f = 0; f < Blend<float>::FIELDS; ++f, index += LANES) pack.lanes()[f] = pick(index);
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
