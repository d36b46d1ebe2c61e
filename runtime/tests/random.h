// Code that the programs in this folder share: random numbers, random materials, random directions, and a check of
// values.
#pragma once

#include <random>

#include "nma/weights.h"

namespace nma::tests {

// Uniform numbers in [0, 1). One of 256 numbers is an end of the range: 0, or the largest float below 1.
class Random {
public:
    explicit Random(unsigned seed) : engine_(seed) {}
    float operator()() {
        const std::uint32_t bits = engine_();
        if ((bits & 0xff) == 0) return bits & 0x100 ? 0.0f : 0.99999994f;
        return static_cast<float>(bits >> 8) * 0x1p-24f;
    }

private:
    std::mt19937 engine_;
};

// Draws each number of the parameters from its training range. The number is uniform, or has a uniform logarithm if the
// parameter is logarithmic.
inline void draw_parameters(const std::vector<SourceParam>& parameters, Random& random, float* to) {
    for (const SourceParam& p : parameters)
        for (int c = 0; c < p.size; ++c) {
            const float low = static_cast<float>(p.low), high = static_cast<float>(p.high), u = random();
            *to++ = p.logarithmic ? low * std::pow(high / low, u) : low + (high - low) * u;
        }
}

// Draws a direction uniformly over the upper hemisphere. However, 2 % of the directions are the normal, and 8 % are
// close to the horizon.
inline Vec3<float> draw_direction(Random& random) {
    const float choice = random(), u = random(), phi = 6.2831853f * random();
    const float z = choice < 0.02f ? 1.0f : choice < 0.1f ? 1e-4f * u + 1e-6f : u;
    const float r = safe_sqrt(1.0f - z * z);
    return {r * std::cos(phi), r * std::sin(phi), z};
}

// Whether a value and a density are finite and not negative.
inline bool sound(const Vec3<float>& v, float pdf) {
    for (const float x : {v.x, v.y, v.z, pdf})
        if (!is_finite(x) || x < 0.0f) return false;
    return true;
}

}  // namespace nma::tests
