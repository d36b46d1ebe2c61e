// The functions that tests/test_runtime_layered.py calls: densities, samples, estimates, walks, albedos and the coat of
// the simulated material.
#include "nma/layered.h"

#include <algorithm>

namespace {

namespace layered = nma::layered;
using layered::Vec;

constexpr Vec NOTHING{0.0f, 0.0f, 0.0f};

Vec vec(const float* v) { return {v[0], v[1], v[2]}; }
void put(const Vec& v, float* to) { std::copy_n(&v.x, 3, to); }

// For each bin of a table, the sum of the weights and the sum of the squared weights. As in nma/table, the indices are
// [row of theta_i, bin of theta_o, bin of phi, colour channel].
struct Bins {
    int o, p;
    double *sums, *squares;

    void add(int row, const Vec& wo, const Vec& weight) const {
        const float turn = nma::absolute(std::atan2(wo.y, wo.x)) * nma::INV_PI<float>;
        const int column = row * o + std::min(static_cast<int>(wo.z * static_cast<float>(o)), o - 1);
        const int bin = 3 * (column * p + std::min(static_cast<int>(turn * static_cast<float>(p)), p - 1));
        const double channels[] = {weight.x, weight.y, weight.z};
        for (int c = 0; c < 3; ++c) {
            sums[bin + c] += channels[c];
            squares[bin + c] += channels[c] * channels[c];
        }
    }
};

// Returns a random view direction at azimuth 0, whose cosine lies in the given row of the table.
Vec view(int row, int rows, layered::Random& random) {
    const float z = (static_cast<float>(row) + random.uniform()) / static_cast<float>(rows);
    return {nma::safe_sqrt(1.0f - z * z), 0.0f, z};
}

// Samples a direction from the material's sampling density, and returns a walk that leaves in this direction. The
// throughput of the walk is an estimate of the value divided by the density.
layered::Walk estimate(const layered::Stack& stack, const Vec& wi, layered::Random& random) {
    const layered::Density density(stack, wi);
    const float u_lobe = random.uniform(), u1 = random.uniform(), u2 = random.uniform();
    const auto drawn = layered::sample(stack, density, wi, u_lobe, u1, u2);
    if (!(drawn.pdf > 0.0f)) return {drawn.wo, NOTHING, 1.0f, false, false};
    return {drawn.wo, layered::evaluate(stack, wi, drawn.wo, random) * (1.0f / drawn.pdf), 1.0f, false, false};
}

}  // namespace

extern "C" {

// Writes the densities of n directions, the rows of `wo`, for one material and one view direction.
void layered_pdf(int n, const float* parameters, const float* wi, const float* wo, float* pdf) {
    const auto stack = layered::Stack::of(parameters);
    const layered::Density density(stack, vec(wi));
    for (int i = 0; i < n; ++i) pdf[i] = layered::pdf(stack, density, vec(wi), vec(wo + 3 * i));
}

// Writes n densities, each for its own material, view direction and `wo`.
void layered_pdf_each(int n, const float* parameters, const float* wi, const float* wo, float* pdf) {
    constexpr int COLUMNS = nma::layered3::COLUMNS;
    for (int i = 0; i < n; ++i) layered_pdf(1, parameters + COLUMNS * i, wi + 3 * i, wo + 3 * i, pdf + i);
}

// `u` has rows of three uniform random numbers. Each row of `out` gets seven numbers: the three components of wo, the
// density of wo, and the three channels of an estimate of the value.
void layered_sample(int n, const float* parameters, const float* wi, const float* u, float* out) {
    const auto stack = layered::Stack::of(parameters);
    const layered::Density density(stack, vec(wi));
    layered::Random random(1, 2);
    for (int i = 0; i < n; ++i, u += 3, out += 7) {
        const auto drawn = layered::sample(stack, density, vec(wi), u[0], u[1], u[2]);
        put(drawn.wo, out);
        out[3] = drawn.pdf;
        put(drawn.pdf > 0.0f ? layered::evaluate(stack, vec(wi), drawn.wo, random) : NOTHING, out + 4);
    }
}

// Writes the throughputs of n walks, with three floats per throughput.
void layered_walks(int n, const float* parameters, const float* wi, float* out) {
    const auto stack = layered::Stack::of(parameters);
    layered::Random random(3, 4);
    for (int i = 0; i < n; ++i) put(layered::walk(stack, vec(wi), random).throughput, out + 3 * i);
}

// Fills a table from random walks (if `walks`) or from estimates (otherwise). Each row of the table gets the weights of
// `per_row` walks or estimates.
void layered_table(bool walks, int rows, int o, int p, int per_row, int seed, const float* parameters, double* sums,
                   double* squares) {
    const auto stack = layered::Stack::of(parameters);
    const Bins bins{o, p, sums, squares};
    for (int row = 0; row < rows; ++row) {
        layered::Random random(static_cast<std::uint64_t>(seed), static_cast<std::uint64_t>(row));
        for (int k = 0; k < per_row; ++k) {
            const Vec wi = view(row, rows, random);
            const layered::Walk made = walks ? layered::walk(stack, wi, random) : estimate(stack, wi, random);
            if (made.throughput.x > 0.0f || made.throughput.y > 0.0f || made.throughput.z > 0.0f)
                bins.add(row, made.direction, made.throughput);
        }
    }
}

// Writes the two results of `out_through_coat` for n pairs of directions, the rows of `wo` and `up`.
void layered_out_through_coat(int n, const float* parameters, const float* wo, const float* up, float* out) {
    const auto stack = layered::Stack::of(parameters);
    for (int i = 0; i < n; ++i)
        std::tie(out[2 * i], out[2 * i + 1]) =
            layered::detail::out_through_coat(stack, vec(wo + 3 * i), vec(up + 3 * i));
}

// Writes the values of the coat's reflection for n pairs of directions, the rows of `wi` and `wo`.
void layered_coat_reflection(int n, const float* parameters, const float* wi, const float* wo, float* out) {
    const auto stack = layered::Stack::of(parameters);
    for (int i = 0; i < n; ++i) out[i] = layered::coat_reflection(stack, vec(wi + 3 * i), vec(wo + 3 * i));
}

void layered_albedo(const float* parameters, const float* wi, float* out) {
    put(layered::albedo(layered::Stack::of(parameters), vec(wi)), out);
}
}
