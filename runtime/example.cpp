// Prints the directional albedo of a material. This program samples the BRDF, as a renderer does at every shading
// point.
//
//     g++ -std=c++17 -O2 -Iruntime runtime/example.cpp -o example
//     ./example nma/adapter/trained/layered3-3x32.safetensors
#include "nma.h"

#include <cstdio>
#include <random>

// The parameters of gold with roughness .1 under a red coat of roughness .02 and index of refraction 1.5.
// CONVENTIONS.md lists the parameters of the class `layered3`.
constexpr float RED_GOLD[nma::layered3::COLUMNS] = {.02f,  .1f,  1.5f, .14f, .37f, 1.44f, 3.98f,
                                                    2.38f, 1.6f, .9f,  .3f,  .2f,  .5f};

int main(int count, char** words) {
    if (count != 2) {
        std::fprintf(stderr, "usage: %s WEIGHTS.safetensors\n", words[0]);
        return 2;
    }
    try {
        const nma::Adapter adapter = nma::Adapter::load(words[1]);
        if (adapter.parameter_count() != nma::layered3::COLUMNS)
            throw nma::Error("this example needs an adapter of the class layered3");
        std::mt19937 engine(1);
        std::uniform_real_distribution<float> uniform;
        std::printf("cos(theta_i)   red   green    blue\n");
        for (const float mu : {.1f, .3f, .5f, .7f, .9f}) {
            const nma::Direction wi{std::sqrt(1.0f - mu * mu), 0.0f, mu};
            const nma::Brdf brdf = adapter.prepare(RED_GOLD, mu);
            constexpr int SAMPLES = 10000;
            nma::Vec3<double> sum{0.0, 0.0, 0.0};
            for (int k = 0; k < SAMPLES; ++k) {
                const nma::Sampled s = brdf.sample(wi, uniform(engine), uniform(engine), uniform(engine));
                if (s.pdf > 0.0f)
                    sum = sum + nma::Vec3<double>{s.value.x / s.pdf, s.value.y / s.pdf, s.value.z / s.pdf};
            }
            const auto albedo = sum * (1.0 / SAMPLES);
            std::printf("%12.1f %6.3f %6.3f %7.3f\n", mu, albedo.x, albedo.y, albedo.z);
        }
    } catch (const nma::Error& e) {
        std::fprintf(stderr, "%s\n", e.what());
        return 1;
    }
}
