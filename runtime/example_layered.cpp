// A small lamp lights the simulated material. This program estimates by four methods how much of the lamp's light the
// material reflects towards the viewer. The four estimates have the same mean. The last two methods use the density
// `pdf` of the material.
//
//     g++ -std=c++17 -O2 -Iruntime runtime/example_layered.cpp -o example_layered
//     ./example_layered
//
// - Walks alone: a random walk leaves the material in a random direction, so few walks meet a small lamp.
// - Evaluation alone: the directions to the lamp are drawn uniformly, so most of them miss the peak of a narrow lobe.
// - Walks and evaluation: a path tracer combines the two estimates above by multiple importance sampling (Veach 1997,
//   eq. 9.8). The weights of multiple importance sampling contain the density of a walk's direction, which has no
//   closed form. The program uses `pdf` instead of the unknown density. The mean stays the same, because the weights of
//   both estimates use `pdf`, and the noise is small, because `pdf` is close to the density of a walk's direction.
// - Samples of `sample`: blends and masks of materials compute weights from the densities of samples, so they need
//   samples whose exact density is known. Directions that `sample` draws have exactly the density `pdf`.
#include <cstdio>

#include "nma/layered.h"

namespace layered = nma::layered;
using layered::Vec;

// The parameters of gold under a red coat. CONVENTIONS.md lists the parameters of the class `layered3`.
constexpr float GOLD[nma::layered3::COLUMNS] = {.01f,  .1f,  1.5f, .14f, .37f, 1.44f, 3.98f,
                                                2.38f, 1.6f, .9f,  .3f,  .2f,  .5f};
// A round lamp of radiance 1. The lamp covers all directions w with dot(w, LAMP) > LAMP_COS, where LAMP points to its
// centre.
constexpr float LAMP_COS = .95f;
constexpr float LAMP_PDF = nma::INV_PI<float> / (2.0f * (1.0f - LAMP_COS));
const Vec VIEW{.6f, 0.0f, .8f}, LAMP{-.8f, 0.0f, .6f};

struct Estimate {
    const char* name;
    double sum = 0.0, squares = 0.0;

    void add(const Vec& light) {
        const double x = nma::luminance(light);
        sum += x;
        squares += x * x;
    }
    void print(int count) const {
        const double mean = sum / count;
        std::printf("%-28s %.5f +- %.5f\n", name, mean, std::sqrt((squares / count - mean * mean) / count));
    }
};

bool lit(const Vec& wo) { return nma::dot(wo, LAMP) > LAMP_COS; }

// A direction to the lamp, drawn uniformly over the solid angle of the lamp.
Vec towards_lamp(float u1, float u2) {
    const float z = 1.0f - u1 * (1.0f - LAMP_COS), r = nma::safe_sqrt(1.0f - z * z), phi = 2.0f * nma::PI<float> * u2;
    const Vec across{LAMP.z, 0.0f, -LAMP.x};
    return LAMP * z + across * (r * nma::cos(phi)) + Vec{0.0f, 1.0f, 0.0f} * (r * nma::sin(phi));
}

int main() {
    const layered::Stack gold = layered::Stack::of(GOLD);
    const layered::Density density(gold, VIEW);
    layered::Random random(1, 1);
    Estimate walks{"walks alone"}, lamp{"evaluate at the lamp alone"}, both{"both, weighed by pdf"},
        exact{"sample, which follows pdf"};
    constexpr int COUNT = 100000;
    for (int k = 0; k < COUNT; ++k) {
        const layered::Walk walk = layered::walk(gold, VIEW, random);
        const Vec met = lit(walk.direction) ? walk.throughput : Vec{0.0f, 0.0f, 0.0f};

        const Vec wo = towards_lamp(random.uniform(), random.uniform());
        const Vec seen = layered::evaluate(gold, VIEW, wo, random) * (1.0f / LAMP_PDF);

        // The weight of a walk that leaves in the direction w towards the lamp. The weight of the evaluation for w is 1
        // minus this weight.
        const auto weight_of_walk = [&](const Vec& w) {
            return layered::pdf(gold, density, VIEW, w) / (layered::pdf(gold, density, VIEW, w) + LAMP_PDF);
        };
        walks.add(met);
        lamp.add(seen);
        both.add(met * weight_of_walk(walk.direction) + seen * (1.0f - weight_of_walk(wo)));

        const float u_lobe = random.uniform(), u1 = random.uniform(), u2 = random.uniform();
        const layered::Drawn drawn = layered::sample(gold, density, VIEW, u_lobe, u1, u2);
        const bool reaches = drawn.pdf > 0.0f && lit(drawn.wo);
        exact.add(reaches ? layered::evaluate(gold, VIEW, drawn.wo, random) * (1.0f / drawn.pdf)
                          : Vec{0.0f, 0.0f, 0.0f});
    }
    std::puts("luminance that the material sends to the viewer");
    for (const Estimate* e : {&walks, &lamp, &both, &exact}) e->print(COUNT);
}
