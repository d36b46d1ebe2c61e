// Measures the C++ runtime, and prints one line of JSON for each measurement. bench/runtime.py compiles and runs
// this program.
//
//     ./runtime [prepared] NAME=WEIGHTS ...
//
// With the word `prepared`, only the functions of prepared BRDFs are measured. Each measurement evaluates the same 240
// random queries on one thread, many times. The result is the shortest time, in nanoseconds per query.
#include "nma.h"

#include <chrono>
#include <cstdio>
#include <random>

#if __has_include(<Eigen/Dense>)
#include <Eigen/Dense>
#define HAS_EIGEN 1
#endif

namespace {

constexpr int QUERIES = 240, REPETITIONS = 100, TURNS = 200;

volatile float sink;

double seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

// Calls `all` several times; each call evaluates every query once. Returns the shortest time, in nanoseconds per query.
template <class F>
double best(F all, int repetitions = REPETITIONS) {
    double least = 1e30;
    for (int k = 0; k < repetitions; ++k) {
        const double began = seconds();
        all();
        least = std::min(least, seconds() - began);
    }
    return least / QUERIES * 1e9;
}

void report(const std::string& network, const std::string& what, const char* set, double nanoseconds) {
    std::printf("{\"network\": \"%s\", \"what\": \"%s\", \"set\": \"%s\", \"ns\": %.2f}\n", network.c_str(),
                what.c_str(), set, nanoseconds);
}

struct Queries {
    std::vector<float> parameters, cosines, uniform;
    std::vector<nma::Direction> wi, wo;

    explicit Queries(const nma::Adapter& adapter) {
        std::mt19937 engine(1);
        std::uniform_real_distribution<float> u;
        for (int q = 0; q < QUERIES; ++q) {
            for (const nma::SourceParam& p : adapter.parameters())
                for (int c = 0; c < p.size; ++c) {
                    const float low = static_cast<float>(p.low), high = static_cast<float>(p.high);
                    parameters.push_back(p.logarithmic ? low * std::pow(high / low, u(engine))
                                                       : low + (high - low) * u(engine));
                }
            cosines.push_back(0.02f + 0.98f * u(engine));
            wi.push_back(direction(cosines.back(), u(engine)));
            wo.push_back(direction(0.02f + 0.98f * u(engine), u(engine)));
            for (int c = 0; c < 3; ++c) uniform.push_back(u(engine));
        }
    }

    static nma::Direction direction(float z, float turn) {
        const float r = std::sqrt(1.0f - z * z), phi = 6.2831853f * turn;
        return {r * std::cos(phi), r * std::sin(phi), z};
    }
};

// An adapter, and all that its measurements read and write.
struct Subject {
    std::string name;
    nma::Adapter adapter;
    Queries queries;
    nma::Curves curves;
    std::vector<nma::Brdf> brdfs;
    std::vector<float> outputs;

    Subject(const std::string& name, const std::string& path, const nma::Options& options)
        : name(name),
          adapter(nma::Adapter::load(path, options)),
          queries(adapter),
          curves(adapter, queries.parameters.data()),
          brdfs(QUERIES),
          outputs(static_cast<std::size_t>(QUERIES) * adapter.output_count()) {
        adapter.prepare_many(QUERIES, queries.parameters.data(), queries.cosines.data(), brdfs.data());
    }
    const float* row(int q) const { return &queries.parameters[q * adapter.parameter_count()]; }
};

// Reports the time of `work(subject)`, which evaluates every query once, for each subject. The subjects take turns, so
// that other programs of the machine slow all of them alike.
template <class F>
void report_all(std::vector<Subject>& subjects, const char* what, const char* set, F work) {
    std::vector<double> least(subjects.size(), 1e30);
    for (int n = 0; n < TURNS; ++n)
        for (std::size_t k = 0; k < subjects.size(); ++k)
            least[k] = std::min(least[k], best([&] { work(subjects[k]); }, 2));
    for (std::size_t k = 0; k < subjects.size(); ++k) report(subjects[k].name, what, set, least[k]);
}

void time_prepare(std::vector<Subject>& subjects, const char* set) {
    report_all(subjects, "inputs and network", set, [](Subject& s) {
        alignas(64) float raw[nma::WIDEST_LAYER];
        for (int q = 0; q < QUERIES; ++q) {
            s.adapter.network_outputs(s.row(q), s.queries.cosines[q], raw);
            sink = raw[0];
        }
    });
    report_all(subjects, "prepare", set, [](Subject& s) {
        for (int q = 0; q < QUERIES; ++q) sink = s.adapter.prepare(s.row(q), s.queries.cosines[q]).blend().weight(0);
    });
    report_all(subjects, "inputs and network, batch", set, [](Subject& s) {
        s.adapter.network_outputs_many(QUERIES, s.row(0), s.queries.cosines.data(), s.outputs.data());
    });
    report_all(subjects, "prepare, batch", set,
               [](Subject& s) { s.adapter.prepare_many(QUERIES, s.row(0), s.queries.cosines.data(), s.brdfs.data()); });
}

// Measures the functions that depend only on the compiler's options, not on the instruction set of the network.
void time_prepared(std::vector<Subject>& subjects, const char* set) {
    report_all(subjects, "curves", set, [](Subject& s) {
        for (int q = 0; q < QUERIES; ++q) sink = s.curves.at(s.queries.cosines[q]).blend().weight(0);
    });
    report_all(subjects, "eval and pdf", set, [](Subject& s) {
        for (int q = 0; q < QUERIES; ++q) sink = s.brdfs[q].eval_pdf(s.queries.wi[q], s.queries.wo[q]).value.x;
    });
    report_all(subjects, "sample, eval and pdf", set, [](Subject& s) {
        for (int q = 0; q < QUERIES; ++q) {
            const float* u = &s.queries.uniform[3 * q];
            sink = s.brdfs[q].sample(s.queries.wi[q], u[0], u[1], u[2]).value.x;
        }
    });
}

// Loads the adapters that the words NAME=WEIGHTS name.
std::vector<Subject> subjects_of(const std::vector<std::string>& words, const nma::Options& options) {
    std::vector<Subject> made;
    for (const std::string& word : words) {
        const std::size_t split = word.find('=');
        made.emplace_back(word.substr(0, split), word.substr(split + 1), options);
    }
    return made;
}

// Measures a network without an adapter, first on one query at a time, then on all queries in one batch. All of the
// network's weights are .01.
void time_network(const std::string& name, const std::vector<int>& sizes, nma::InstructionSet set, bool compact,
                  int repetitions = REPETITIONS) {
    std::vector<nma::Layer> layers;
    double products = 0.0;
    for (std::size_t k = 0; k + 1 < sizes.size(); ++k) {
        nma::Layer layer;
        layer.in = sizes[k];
        layer.out = sizes[k + 1];
        layer.matrix.assign(static_cast<std::size_t>(layer.in) * layer.out, 0.01f);
        layer.bias.assign(layer.out, 0.0f);
        products += static_cast<double>(layer.in) * layer.out;
        layers.push_back(layer);
    }
    const nma::Network network(layers, set, compact);
    const auto inputs = nma::detail::aligned<float>(static_cast<std::size_t>(QUERIES) * network.input_stride());
    const auto outputs = nma::detail::aligned<float>(static_cast<std::size_t>(QUERIES) * network.output_stride());
    const std::string label = std::string(nma::name(set)) + (compact ? " compact" : "");
    report(name, "network", label.c_str(), best([&] {
        for (int q = 0; q < QUERIES; ++q) network.forward(inputs.get() + q * network.input_stride(), outputs.get());
    }, repetitions));
    const double many = best([&] { network.forward_many(QUERIES, inputs.get(), outputs.get()); }, repetitions);
    report(name, "network, batch", label.c_str(), many);
    std::printf("{\"network\": \"%s\", \"what\": \"multiply-adds per ns, batch\", \"set\": \"%s\", \"ns\": %.2f}\n",
                name.c_str(), label.c_str(), products / many);
}

#ifdef HAS_EIGEN
void time_eigen(const std::string& name, const std::vector<int>& sizes) {
    std::vector<Eigen::MatrixXf> matrices;
    std::vector<Eigen::VectorXf> biases;
    for (std::size_t k = 0; k + 1 < sizes.size(); ++k) {
        matrices.push_back(Eigen::MatrixXf::Constant(sizes[k + 1], sizes[k], 0.01f));
        biases.push_back(Eigen::VectorXf::Zero(sizes[k + 1]));
    }
    const auto forward = [&](auto x) {
        for (std::size_t k = 0; k < matrices.size(); ++k) {
            x = ((matrices[k] * x).colwise() + biases[k]).eval();
            if (k + 1 < matrices.size()) x = x.cwiseMax(0.0f).eval();
        }
        sink = x(0, 0);
    };
    const Eigen::VectorXf one = Eigen::VectorXf::Ones(sizes[0]);
    const Eigen::MatrixXf many = Eigen::MatrixXf::Ones(sizes[0], QUERIES);
    report(name, "network", "Eigen", best([&] {
        for (int q = 0; q < QUERIES; ++q) {
            Eigen::VectorXf x = one;
            for (std::size_t k = 0; k < matrices.size(); ++k) {
                x = (matrices[k] * x + biases[k]).eval();
                if (k + 1 < matrices.size()) x = x.cwiseMax(0.0f).eval();
            }
            sink = x(0);
        }
    }));
    report(name, "network, batch", "Eigen", best([&] { forward(many); }));
}
#endif

// Returns the highest rate of this core, in multiply-adds per nanosecond. The rate is measured with 12 independent
// chains of multiply-adds.
NMA_TARGET("avx512f,fma") double peak_avx512() {
#ifdef NMA_X86
    __m512 sums[12];
    for (auto& sum : sums) sum = _mm512_set1_ps(0.5f);
    const __m512 factor = _mm512_set1_ps(0.999f), step = _mm512_set1_ps(0.001f);
    double most = 0.0;
    for (int k = 0; k < 20; ++k) {
        constexpr long STEPS = 200000;
        const double began = seconds();
        for (long n = 0; n < STEPS; ++n) {
            NMA_UNROLL for (int i = 0; i < 12; ++i) sums[i] = _mm512_fmadd_ps(sums[i], factor, step);
        }
        most = std::max(most, STEPS * 12.0 * 16.0 / (seconds() - began) / 1e9);
    }
    for (auto& sum : sums) sink = _mm512_cvtss_f32(sum);
    return most;
#else
    return 0.0;
#endif
}

}  // namespace

int main(int count, char** arguments) {
    using nma::InstructionSet;
    std::vector<std::string> words(arguments + 1, arguments + count);
    if (!words.empty() && words[0] == "prepared") {
        words.erase(words.begin());
        std::vector<Subject> subjects = subjects_of(words, {});
        time_prepared(subjects, "any, plain");
        return 0;
    }
    if (nma::supported(InstructionSet::avx512)) report("", "peak multiply-adds per ns", "avx512", peak_avx512());
    const std::pair<const char*, std::vector<int>> networks[] = {{"5x64", {16, 64, 64, 64, 64, 64, 23}},
                                                                 {"3x32", {16, 32, 32, 32, 23}}};
    // A decoder with about as many parameters as the decoder of Fan et al. 2022: 1.07 million.
    const std::vector<int> large{38, 512, 512, 512, 512, 512, 3};
    for (const InstructionSet set : nma::INSTRUCTION_SETS) {
        if (!nma::supported(set)) continue;
        const bool rounds = set == InstructionSet::avx512_bf16;
        for (const bool compact : {false, true}) {
            if (rounds && !compact) continue;
            for (const auto& [name, sizes] : networks) time_network(name, sizes, set, compact);
            std::vector<Subject> subjects = subjects_of(words, {set, compact});
            time_prepare(subjects, (std::string(nma::name(set)) + (compact ? " compact" : "")).c_str());
        }
        time_network("1.07 M", large, set, rounds, 10);
    }
    std::vector<Subject> subjects = subjects_of(words, {});
    time_prepared(subjects, "any");
#ifdef HAS_EIGEN
    for (const auto& [name, sizes] : networks) time_eigen(name, sizes);
#endif
}
