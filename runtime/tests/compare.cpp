// Compares the network on every instruction set of this CPU with the portable code.
//
//     c++ -std=c++17 -O2 -Iruntime runtime/tests/compare.cpp -o compare
//     ./compare WEIGHTS
#include "nma.h"

#include <cstdio>
#include <random>

namespace {

constexpr int QUERIES = 1000;

std::vector<float> outputs(const nma::Adapter& adapter, const std::vector<float>& parameters,
                           const std::vector<nma::Direction>& wi, bool batch) {
    std::vector<float> found(static_cast<std::size_t>(QUERIES) * adapter.output_count());
    if (batch) adapter.network_outputs_many(QUERIES, parameters.data(), wi.data(), found.data());
    else
        for (int q = 0; q < QUERIES; ++q) {
            alignas(64) float raw[nma::WIDEST_LAYER];
            adapter.network_outputs(&parameters[static_cast<std::size_t>(q) * adapter.parameter_count()], wi[q], raw);
            std::copy_n(raw, adapter.output_count(), &found[static_cast<std::size_t>(q) * adapter.output_count()]);
        }
    return found;
}

}  // namespace

int main(int count, char** words) {
    if (count != 2) {
        std::fprintf(stderr, "usage: %s WEIGHTS\n", words[0]);
        return 2;
    }
    const nma::Adapter portable = nma::Adapter::load(words[1], {nma::InstructionSet::portable, false});
    std::mt19937 engine(1);
    std::uniform_real_distribution<float> uniform;
    std::vector<float> parameters;
    std::vector<nma::Direction> wi;
    for (int q = 0; q < QUERIES; ++q) {
        const float z = uniform(engine), r = std::sqrt(1.0f - z * z), phi = 6.2831853f * uniform(engine);
        wi.push_back({r * std::cos(phi), r * std::sin(phi), z});
        for (const nma::SourceParam& p : portable.parameters())
            for (int c = 0; c < p.size; ++c)
                parameters.push_back(static_cast<float>(p.low + (p.high - p.low) * uniform(engine)));
    }
    const std::vector<float> wanted = outputs(portable, parameters, wi, false);
    bool fine = true;
    for (const nma::InstructionSet set : nma::INSTRUCTION_SETS) {
        if (!nma::supported(set)) continue;
        const nma::Adapter adapter = nma::Adapter::load(words[1], {set, false});
        for (const bool batch : {false, true}) {
            const std::vector<float> found = outputs(adapter, parameters, wi, batch);
            double worst = 0.0, squares = 0.0;
            for (std::size_t k = 0; k < wanted.size(); ++k) {
                const double error = std::abs(found[k] - wanted[k]) / (1.0 + std::abs(wanted[k]));
                worst = std::max(worst, error);
                squares += error * error;
            }
            // With avx512_bf16, errors are large, because each activation keeps only 8 significant bits. The float32
            // instruction sets add the terms of a sum in different orders, so they round differently. The rounding
            // errors grow with the terms, which are larger than the outputs, so the tolerance is larger than the
            // rounding error of one output.
            const bool rounded = set == nma::InstructionSet::avx512_bf16;
            const double rms = std::sqrt(squares / static_cast<double>(wanted.size()));
            fine &= rounded ? rms < 0.02 : rms < 1e-6 && worst < 3e-5;
            std::printf("%-11s %s  worst %.1e  rms %.1e, relative to 1 + |output|\n", nma::name(set),
                        batch ? "batch" : "single", worst, rms);
        }
    }
    return fine ? 0 : 1;
}
