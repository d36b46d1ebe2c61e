// What tests/test_runtime_layered.py calls: the simulated material's density, samples of it, estimates, walks, albedos.
#include "nma/layered.h"

#include <algorithm>

namespace {

using nma::layered::Vec;

Vec vec(const float* v) { return {v[0], v[1], v[2]}; }
void put(const Vec& v, float* to) { std::copy_n(&v.x, 3, to); }

}  // namespace

extern "C" {

// All for one material, seen from one direction; rows of `wo`.
void layered_pdf(int n, const float* parameters, const float* wi, const float* wo, float* pdf) {
    const auto layers = nma::layered::Layers::of(parameters);
    const nma::layered::Density density(layers, vec(wi));
    for (int i = 0; i < n; ++i) pdf[i] = nma::layered::pdf(layers, density, vec(wi), vec(wo + 3 * i));
}

// Rows of three uniform numbers to rows of wo, its density, and an estimate of the value.
void layered_sample(int n, const float* parameters, const float* wi, const float* u, float* out) {
    const auto layers = nma::layered::Layers::of(parameters);
    const nma::layered::Density density(layers, vec(wi));
    nma::layered::Random random(1, 2);
    for (int i = 0; i < n; ++i, u += 3, out += 7) {
        const auto drawn = nma::layered::sample(layers, density, vec(wi), u[0], u[1], u[2]);
        put(drawn.wo, out);
        out[3] = drawn.pdf;
        put(drawn.pdf > 0.0f ? nma::layered::evaluate(layers, vec(wi), drawn.wo, random) : Vec{0.0f, 0.0f, 0.0f},
            out + 4);
    }
}

// Rows of throughputs.
void layered_walks(int n, const float* parameters, const float* wi, float* out) {
    const auto layers = nma::layered::Layers::of(parameters);
    nma::layered::Random random(3, 4);
    for (int i = 0; i < n; ++i) put(nma::layered::walk(layers, vec(wi), random).throughput, out + 3 * i);
}

void layered_albedo(const float* parameters, const float* wi, float* out) {
    put(nma::layered::albedo(nma::layered::Layers::of(parameters), vec(wi)), out);
}
}
