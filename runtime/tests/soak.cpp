// Random materials and directions by the million: nothing is NaN, infinite or negative, and samples agree with eval.
//
//     c++ -std=c++17 -O2 -pthread -Iruntime runtime/tests/soak.cpp -o soak
//     ./soak CALLS WEIGHTS        calls of eval_pdf, pdf and sample together; threads share the adapter
#include "nma.h"

#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <thread>

namespace {

constexpr int CALLS_PER_ROUND = 18;
constexpr float TOLERANCE = 1e-4f;

// Uniform numbers in [0, 1), now and then an end of the range.
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

// Training ranges: widths by powers, the conductor and the medium uniformly.
void draw_parameters(const nma::Adapter& adapter, Random& random, float* to) {
    for (const nma::SourceParam& p : adapter.parameters())
        for (int c = 0; c < p.size; ++c) {
            const float low = static_cast<float>(p.low), high = static_cast<float>(p.high), u = random();
            *to++ = p.logarithmic ? low * std::pow(high / low, u) : low + (high - low) * u;
        }
}

// Over the hemisphere, now and then at the pole or near the horizon.
nma::Direction draw_direction(Random& random) {
    const float choice = random(), u = random(), phi = 6.2831853f * random();
    const float z = choice < 0.02f ? 1.0f : choice < 0.1f ? 1e-4f * u + 1e-6f : u;
    const float r = nma::safe_sqrt(1.0f - z * z);
    return {r * std::cos(phi), r * std::sin(phi), z};
}

bool sound(const nma::Vec3<float>& v, float pdf) {
    for (const float x : {v.x, v.y, v.z, pdf})
        if (!nma::is_finite(x) || x < 0.0f) return false;
    return true;
}

bool close(float a, float b) { return std::abs(a - b) <= TOLERANCE * std::max(std::abs(a), std::abs(b)); }

// A material, and `CALLS_PER_ROUND` calls. Returns what is wrong, or null.
const char* round_of_calls(const nma::Adapter& adapter, Random& random) {
    float parameters[64];
    draw_parameters(adapter, random, parameters);
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
