// What `Adapter::prepare` works with, and the step of it that is the same on every instruction set.
#pragma once

#include "blend.h"
#include "encoding.h"
#include "kernels/layout.h"

namespace nma {

struct Recipe {
    Encoding encoding;
    NetworkView network;
    Ranges ranges;
    int instances, outputs;
    bool bounded;
    // The number that each lane of each field takes, of one pack after the other. Lanes without one take the number after
    // all others, which is 0.
    const int* lanes;
};

// The instances and weights of a blend from their numbers, after which there is room for another.
inline void assemble(const Recipe& recipe, float* numbers, Blend<float>& blend) {
    blend.count = recipe.instances;
    blend.scale = {1.0f, 1.0f, 1.0f};
    numbers[recipe.ranges.count] = 0.0f;
    const int* index = recipe.lanes;
    const float* share = numbers + recipe.outputs - (blend.count - 1);
    float left = 1.0f;
    for (int n = 0; n < blend.used(); ++n) {
        Pack<float>& pack = blend.packs[n];
        Lanes<float>* lanes = pack.lanes();
        for (int f = 0; f < Blend<float>::FIELDS; ++f, index += LANES) lanes[f] = {numbers[index[0]], numbers[index[1]], numbers[index[2]], numbers[index[3]]};
        float weights[LANES] = {};
        for (int k = n * LANES; k < std::min(blend.count, (n + 1) * LANES); ++k) {
            const float part = k + 1 < blend.count ? *share++ : 1.0f;
            weights[k % LANES] = left * part;
            left -= left * part;
        }
        pack.weights = {weights[0], weights[1], weights[2], weights[3]};
    }
}

}  // namespace nma
