// Tests that loading damaged or random bytes as a weights file either throws an `nma::Error` or returns an adapter that
// works.
//
// Guided by coverage:   clang++ -std=c++17 -O1 -g -fsanitize=fuzzer,address,undefined -DNMA_LIBFUZZER -Iruntime
//                           runtime/tests/fuzz.cpp -o fuzz
//                       ./fuzz -max_total_time=600 -max_len=4000 CORPUS
// By chance alone:      c++ -std=c++17 -O1 -g -fsanitize=address,undefined -Iruntime runtime/tests/fuzz.cpp -o fuzz
//                       ./fuzz COUNT WEIGHTS ...    changes bytes, words and lengths of these files, COUNT times each
#include "nma.h"

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <random>

#include "random.h"

namespace {

using nma::tests::sound;

void require(bool sound) {
    if (!sound) std::abort();
}

// Loads an adapter from `data`, and prepares and evaluates a BRDF. Returns false if loading throws an `nma::Error`. Any
// other exception ends the program.
bool attempt(const std::uint8_t* data, std::size_t size) {
    try {
        const nma::Adapter adapter = nma::Adapter::from_memory(data, size);
        std::vector<float> parameters(adapter.parameter_count(), 0.5f);
        if (!adapter.material().empty()) parameters = adapter.material();
        adapter.clamp(parameters.data());
        require(adapter.check(parameters.data()) < 0);
        const nma::Direction wi{0.5196152f, 0.6928203f, 0.5f};
        const nma::Brdf brdf = adapter.prepare(parameters.data(), wi);
        const nma::Value v = brdf.eval_pdf(wi, {0.0f, 0.6f, 0.8f});
        const nma::Sampled s = brdf.sample(wi, 0.3f, 0.4f, 0.5f);
        require(sound(v.value, v.pdf) && sound(s.value, s.pdf));
        return true;
    } catch (const nma::Error&) {
        return false;
    }
}

}  // namespace

#ifdef NMA_LIBFUZZER
extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    attempt(data, size);
    return 0;
}
#else
namespace {

// Returns the bytes of a weights file with one to four random changes, most of them in the header.
std::string changed(std::string bytes, std::mt19937& engine) {
    static constexpr const char* WORDS[] = {
        "null", "-1", "1e308", "[", "}", "\"", "\\u0000", "0", "4096", "true", "layer0.weight", "99999999999999999999"};
    const auto below = [&](std::size_t n) { return static_cast<std::size_t>(engine()) % std::max<std::size_t>(n, 1); };
    for (std::size_t k = 0, changes = 1 + below(4); k < changes && !bytes.empty(); ++k) {
        const std::size_t place = below(below(8) ? std::min<std::size_t>(bytes.size(), 4000) : bytes.size());
        const std::string word = WORDS[below(std::size(WORDS))];
        switch (below(5)) {
            case 0:
                bytes[place] = static_cast<char>(engine());
                break;
            case 1:
                bytes[place] ^= static_cast<char>(1 << below(8));
                break;
            case 2:
                bytes.resize(place);
                break;
            case 3:
                bytes.replace(place, std::min(word.size(), bytes.size() - place), word);
                break;
            default:
                bytes.insert(place, word);
        }
    }
    return bytes;
}

}  // namespace

int main(int count, char** words) {
    if (count < 3) {
        std::fprintf(stderr, "usage: %s COUNT WEIGHTS ...\n", words[0]);
        return 2;
    }
    std::mt19937 engine(1);
    long loaded = 0, total = 0;
    for (int k = 2; k < count; ++k) {
        const std::string bytes = nma::read_file(words[k]);
        if (!attempt(reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size())) return 1;
        for (long n = 0; n < std::atol(words[1]); ++n, ++total) {
            const std::string other = changed(bytes, engine);
            loaded += attempt(reinterpret_cast<const std::uint8_t*>(other.data()), other.size());
        }
    }
    std::printf("%ld files, %ld of them loaded\n", total, loaded);
}
#endif
