// Tests millions of random materials and directions: values and densities must be finite and not negative, and the
// results of `sample` must agree with those of `eval_pdf`.
//
//     c++ -std=c++17 -O2 -pthread -Iruntime runtime/tests/soak.cpp -o soak
//     ./soak CALLS WEIGHTS        CALLS counts eval_pdf, pdf and sample together; threads share the adapter
#include "nma.h"

#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <thread>

#include "random.h"

namespace {

using nma::tests::draw_direction;
using nma::tests::Random;
using nma::tests::sound;

constexpr int CALLS_PER_ROUND = 18;
constexpr float TOLERANCE = 1e-4f;

bool close(float a, float b) { return std::abs(a - b) <= TOLERANCE * std::max(std::abs(a), std::abs(b)); }

// Prepares a random material and makes CALLS_PER_ROUND calls. Returns the name of the function whose result is wrong,
// or null.
const char* round_of_calls(const nma::Adapter& adapter, Random& random) {
    float parameters[64];
    nma::tests::draw_parameters(adapter.parameters(), random, parameters);
    const nma::Direction wi = draw_direction(random);
    const nma::Brdf brdf = adapter.prepare(parameters, wi);
    for (int k = 0; k < CALLS_PER_ROUND / 6; ++k) {
        const nma::Direction wo = draw_direction(random);
        const nma::Value v = brdf.eval_pdf(wi, wo);
        if (!sound(v.value, v.pdf)) return "eval_pdf";
        if (!close(brdf.pdf(wi, wo), v.pdf)) return "pdf against eval_pdf";
        for (int n = 0; n < 2; ++n) {
            const nma::Sampled s = brdf.sample(wi, random(), random(), random());
            if (!sound(s.value, s.pdf)) return "sample";
            if (s.pdf == 0.0f) continue;
            const nma::Value again = brdf.eval_pdf(wi, s.wo);
            if (!close(again.pdf, s.pdf) || !close(again.value.x, s.value.x) || !close(again.value.y, s.value.y) ||
                !close(again.value.z, s.value.z))
                return "sample against eval_pdf";
        }
    }
    return nullptr;
}

}  // namespace

int main(int count, char** words) {
    if (count != 3) {
        std::fprintf(stderr, "usage: %s CALLS WEIGHTS\n", words[0]);
        return 2;
    }
    const nma::Adapter adapter = nma::Adapter::load(words[2]);
    const unsigned threads = std::max(2u, std::thread::hardware_concurrency());
    const long rounds = std::atol(words[1]) / CALLS_PER_ROUND / threads + 1;
    std::atomic<long> faults{0};
    std::vector<std::thread> running;
    for (unsigned t = 0; t < threads; ++t)
        running.emplace_back([&, t] {
            Random random(t + 1);
            for (long n = 0; n < rounds; ++n)
                if (const char* what = round_of_calls(adapter, random)) {
                    if (faults++ < 10) std::fprintf(stderr, "thread %u, round %ld: %s\n", t, n, what);
                }
        });
    for (std::thread& thread : running) thread.join();
    std::printf("%ld calls on %s, %ld faults\n", rounds * CALLS_PER_ROUND * threads,
                nma::name(adapter.instruction_set()), faults.load());
    return faults ? 1 : 0;
}
