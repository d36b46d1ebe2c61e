// Tests the simulated material with random parameters and with extreme parameters: values, densities and throughputs
// must be finite and not negative.
//
//     c++ -std=c++17 -O2 -Iruntime runtime/tests/soak_layered.cpp -o soak_layered
//     ./soak_layered CALLS        CALLS counts walk, evaluate, pdf, sample and albedo together
#include <cstdio>
#include <cstdlib>

#include "nma/generated/classes.h"
#include "nma/layered.h"
#include "random.h"

namespace {

namespace layered = nma::layered;
using nma::tests::draw_direction;
using nma::tests::sound;

constexpr int CALLS_PER_ROUND = 8;

// Extreme materials: smooth and rough, thin and thick, index-matched, and without absorption.
constexpr float HARD[][nma::layered3::COLUMNS] = {
    {1e-4f, 1e-4f, 1.0f, 0.24f, 0.96f, 1.18f, 3.9f, 2.6f, 2.4f, 0.9f, 0.5f, 0.1f, 1.0f},
    {1e-3f, 2e-3f, 1.5f, 0.24f, 0.96f, 1.18f, 3.9f, 2.6f, 2.4f, 0.8f, 0.8f, 0.8f, 0.3f},
    {1e-4f, 1.0f, 4.0f, 0.0f, 0.0f, 0.0f, 1.0f, 1.0f, 1.0f, 1.0f, 1.0f, 1.0f, 0.0f},
    {1.0f, 1e-4f, 1.001f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 1.0f, 1.0f, 1.0f, 1000.0f},
    {0.3f, 2e-3f, 1.05f, 1e4f, 0.0f, 1e4f, 0.0f, 1e4f, 1e4f, 0.0f, 0.5f, 1.0f, 4.0f},
};

// Makes CALLS_PER_ROUND calls for a material. Returns the name of the function whose result is wrong, or null.
const char* round_of_calls(const layered::Stack& stack, nma::tests::Random& random, layered::Random& walking) {
    const layered::Vec wi = draw_direction(random);
    const layered::Density density(stack, wi);
    for (int k = 0; k < 2; ++k) {
        const layered::Walk walk = layered::walk(stack, wi, walking);
        if (!sound(walk.throughput, 0.0f)) return "walk";
        if (walk.throughput.x > 0.0f && !(walk.direction.z > 0.0f)) return "where a walk leaves";
        const layered::Vec wo = draw_direction(random);
        if (!sound(layered::evaluate(stack, wi, wo, walking), layered::pdf(stack, density, wi, wo))) return "evaluate";
        const layered::Drawn drawn = layered::sample(stack, density, wi, random(), random(), random());
        if (!nma::is_finite(drawn.pdf) || drawn.pdf < 0.0f) return "sample";
        if (drawn.pdf > 0.0f && !sound(layered::evaluate(stack, wi, drawn.wo, walking), 0.0f))
            return "evaluate a sample";
    }
    return sound(layered::albedo(stack, wi, 2), 0.0f) ? nullptr : "albedo";
}

}  // namespace

int main(int count, char** words) {
    if (count != 2) {
        std::fprintf(stderr, "usage: %s CALLS\n", words[0]);
        return 2;
    }
    const std::vector<nma::SourceParam> parameters = nma::layered3_parameters();
    const long rounds = std::atol(words[1]) / CALLS_PER_ROUND + 1;
    nma::tests::Random random(1);
    layered::Random walking(1, 2);
    long faults = 0;
    for (long n = 0; n < rounds; ++n) {
        float drawn[nma::layered3::COLUMNS];
        nma::tests::draw_parameters(parameters, random, drawn);
        const float* material = n % 2 ? HARD[n / 2 % std::size(HARD)] : drawn;
        if (const char* what = round_of_calls(layered::Stack::of(material), random, walking))
            if (faults++ < 10) std::fprintf(stderr, "round %ld: %s\n", n, what);
    }
    std::printf("%ld calls, %ld faults\n", rounds * CALLS_PER_ROUND, faults);
    return faults ? 1 : 0;
}
