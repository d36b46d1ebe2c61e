// Neural Material Adapter: expensive materials rendered as blends of Principled BRDFs that a tiny network prepares.
//
//     const nma::Adapter adapter = nma::Adapter::load("layered3-5x64.safetensors");
//     adapter.clamp(parameters);                                         // or refuse them: adapter.check(parameters)
//     const nma::Brdf brdf = adapter.prepare(parameters, wi);            // once per shading point
//     const nma::Value v = brdf.eval_pdf(wi, wo);                        // f cos(theta_o) [1/sr] and pdf [1/sr]
//     const nma::Sampled s = brdf.sample(wi, u_lobe, u1, u2);
//
// C++17, no dependencies. The network runs on the widest vectors of the CPU at hand (`InstructionSet`). Loading and
// making `Curves` allocate and throw `nma::Error`; everything else does neither and is safe to call from many threads
// at once. Directions are unit vectors in the local frame, z up, `wi` towards the viewer, `wo` towards the light. Lobes
// of adapters with `in_plane` parameters are stretched along the plane of incidence, which is found here.
#pragma once

#include <cstddef>

#include "nma/blend.h"
#include "nma/network.h"
#include "nma/weights.h"

namespace nma {

using Direction = Vec3<float>;
using Value = Evaluation<float>;
using Sampled = Sample<float>;

// The BRDF at one shading point, for the cos(theta_i), of anisotropic adapters the `wi`, that it was prepared for.
class Brdf {
public:
    // f cos(theta_o) [1/sr], 0 below the horizon.
    Vec3<float> eval(const Direction& wi, const Direction& wo) const { return eval_pdf(wi, wo).value; }

    // The density of `sample` [1/sr], 0 below the horizon.
    float pdf(const Direction& wi, const Direction& wo) const { return eval_pdf(wi, wo).pdf; }

    // Both at the price of one.
    Value eval_pdf(const Direction& wi, const Direction& wo) const {
        const Plane<float> plane = frame(wi);
        return nma::eval_pdf(blend_, plane_enter<float>(plane, wi), plane_enter<float>(plane, wo));
    }

    // A direction from three uniform numbers in [0, 1), with its value and density; pdf == 0 marks an invalid one.
    Sampled sample(const Direction& wi, float u_lobe, float u1, float u2) const {
        const Plane<float> plane = frame(wi);
        Sampled found = nma::sample(blend_, plane_enter<float>(plane, wi), u_lobe, u1, u2);
        found.wo = plane_leave<float>(plane, found.wo);
        return found;
    }

    // The directional albedo at `wi`, at most 1, which denoisers ask for: the mean over samples at fixed points
    // (Roberts 2018, "R2").
    Vec3<float> albedo(const Direction& wi, int points = 128) const {
        const auto fraction = [](float x) { return x - std::floor(x); };
        Vec3<float> sum{0.0f, 0.0f, 0.0f};
        for (int k = 0; k < points; ++k) {
            const float n = static_cast<float>(k) + 0.5f;
            const Sampled s =
                sample(wi, n / static_cast<float>(points), fraction(n * 0.75487767f), fraction(n * 0.56984029f));
            if (s.pdf > 0.0f) sum = sum + s.value * (1.0f / s.pdf);
        }
        const float share = 1.0f / static_cast<float>(points);
        return {minimum(sum.x * share, 1.0f), minimum(sum.y * share, 1.0f), minimum(sum.z * share, 1.0f)};
    }

    const Blend<float>& blend() const { return blend_; }

private:
    friend class Adapter;
    friend class Curves;

    // Found anew at each call: a BRDF that was prepared for a cosine alone serves all azimuths.
    Plane<float> frame(const Direction& wi) const { return in_plane_ ? plane_of<float>(wi) : Plane<float>{1.0f, 0.0f}; }

    Blend<float> blend_;
    bool in_plane_ = false;
};

// What `Brdf` was called before.
using Material = Brdf;

// How a weights file is loaded.
struct Options {
    // All but avx512_bf16 compute in float32; that one halves a network's time by rounding activations to 8 bits.
    InstructionSet set = fastest();
    // Rounds weights to bfloat16, which halves the memory that a query has to fetch. Both shipped adapters lost less
    // than .00002 of log loss by it; avx512_bf16 always does it.
    bool compact = false;
};

class Adapter {
public:
    // Queries that `prepare_many` works on at once.
    static constexpr int BLOCK = 24;

    static Adapter load(const std::string& path, const Options& options = {}) {
        try {
            const std::string bytes = read_file(path);
            return from_memory(bytes.data(), bytes.size(), options);
        } catch (const Error& e) {
            throw Error(path + ": " + e.what());
        }
    }

    static Adapter from_memory(const void* bytes, std::size_t size, const Options& options = {}) {
        return Adapter(parse_weights(bytes, size), options);
    }

    // Numbers that `prepare` takes, in the order of `parameters`.
    int parameter_count() const { return recipe_.encoding.parameters(); }
    const std::vector<SourceParam>& parameters() const { return weights_.parameters; }
    // The parameters of the only material that it knows, which `prepare` does not read; empty where it knows a class.
    const std::vector<float>& material() const { return weights_.material; }
    // The number of the first of them that is not finite or beyond its training range, where the network makes up
    // plausible values, or, if it knows a single material, not of that; -1 if there is none. `parameter` says whose
    // number it is.
    int check(const float* parameters) const {
        for (int k = 0; k < parameter_count(); ++k)
            if (!knows(k, parameters[k])) return k;
        return -1;
    }
    // Moves each into its training range, NaN to the lower end. Where it knows a single material, nothing moves.
    void clamp(float* parameters) const {
        if (!material().empty()) return;
        for (int k = 0; k < parameter_count(); ++k) parameters[k] = parameter(k).clamped(parameters[k]);
    }
    const SourceParam& parameter(int number) const { return weights_.parameters[owners_[number]]; }

    // Numbers that describe a blend, and what the network returns for them.
    int output_count() const { return recipe_.outputs; }
    InstructionSet instruction_set() const { return network_.instruction_set(); }

    // Whether the view's azimuth matters; where it does not, of `wi` only wi.z does. A cosine c in place of `wi` stands
    // for the azimuth 0: wi = (sqrt(1 - c^2), 0, c).
    bool anisotropic() const { return recipe_.encoding.anisotropic(); }

    // The BRDF for the parameters of the source material, seen from `wi`.
    Brdf prepare(const float* parameters, const Direction& wi) const {
        Brdf made;
        made.in_plane_ = in_plane_;
        kernels().prepare(recipe_, parameters, wi, made.blend_);
        return made;
    }
    Brdf prepare(const float* parameters, float cos_theta_i) const {
        return prepare(parameters, at_azimuth_0(cos_theta_i));
    }

    // The same for many shading points, whose parameters are rows: queries share the loads of the weights.
    void prepare_many(int count, const float* parameters, const Direction* wi, Brdf* brdfs) const {
        alignas(64) float outputs[BLOCK * WIDEST_LAYER];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            outputs_of_block(now, row(parameters, first), wi + first, outputs);
            for (int q = 0; q < now; ++q) {
                Brdf& made = brdfs[first + q];
                made.in_plane_ = in_plane_;
                kernels().decode(recipe_, outputs + q * network_.output_stride(), wi[first + q].z, made.blend_);
            }
            for (int q = first; q < first + now; ++q) kernels().odds(recipe_, wi[q].z, brdfs[q].blend_);
        }
    }
    void prepare_many(int count, const float* parameters, const float* cos_theta_i, Brdf* brdfs) const {
        in_blocks(count, cos_theta_i, [&](int first, int now, const Direction* wi) {
            prepare_many(now, row(parameters, first), wi, brdfs + first);
        });
    }

    // What the network returns, before decoding; `raw` is aligned to 64 bytes and has room for WIDEST_LAYER numbers.
    void network_outputs(const float* parameters, const Direction& wi, float* raw) const {
        alignas(64) float inputs[WIDEST_LAYER];
        kernels().encode(recipe_, parameters, wi, inputs);
        network_.forward(inputs, raw);
    }
    void network_outputs(const float* parameters, float cos_theta_i, float* raw) const {
        network_outputs(parameters, at_azimuth_0(cos_theta_i), raw);
    }

    // Likewise for many, rows of `output_count` numbers.
    void network_outputs_many(int count, const float* parameters, const Direction* wi, float* raw) const {
        alignas(64) float outputs[BLOCK * WIDEST_LAYER];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            outputs_of_block(now, row(parameters, first), wi + first, outputs);
            for (int q = 0; q < now; ++q)
                std::copy_n(outputs + q * network_.output_stride(), output_count(),
                            raw + static_cast<std::size_t>(first + q) * output_count());
        }
    }
    void network_outputs_many(int count, const float* parameters, const float* cos_theta_i, float* raw) const {
        in_blocks(count, cos_theta_i, [&](int first, int now, const Direction* wi) {
            network_outputs_many(now, row(parameters, first), wi,
                                 raw + static_cast<std::size_t>(first) * output_count());
        });
    }

private:
    friend class Curves;

    Adapter(Weights weights, const Options& options) : weights_(std::move(weights)) {
        for (const TargetParam& p : weights_.target) add_fields(p);
        for (std::size_t k = 0; k < weights_.parameters.size(); ++k)
            owners_.insert(owners_.end(), weights_.parameters[k].size, k);
        recipe_.encoding = Encoding(weights_);
        recipe_.instances = weights_.instances;
        recipe_.outputs = static_cast<int>(fields_.size()) * weights_.instances + weights_.instances - 1;
        recipe_.bounded = weights_.bounded;
        check();
        weights_.layers.front() = recipe_.encoding.arranged(weights_.layers.front());
        network_ = Network(weights_.layers, options.set, options.compact);
        recipe_.network = network_.view();
        lay_out_ranges();
        lay_out_lanes();
        weights_.layers.clear();
    }

    const Kernels& kernels() const { return network_.kernels_in_use(); }

    // Whether a material may have x for its parameter number `k`.
    bool knows(int k, float x) const {
        if (material().empty()) return parameter(k).allows(x);
        return same(x, material()[k]);
    }

    // Remembers which fields of a `Principled` the numbers of a parameter become.
    void add_fields(const TargetParam& p) {
        in_plane_ |= p.in_plane;
        const int first = static_cast<int>(detail::field(p.name, p.size).first);
        for (int c = 0; c < p.size; ++c) fields_.push_back(first + c);
    }

    // Refuses a network that does not fit its own description, or this version's target.
    void check() const {
        if (anisotropic() && (in_plane_ || !weights_.directional))
            throw Error(
                "anisotropic, but its target holds in the plane of incidence, or ignores the direction; train again");
        if (weights_.dialect != DIALECT)
            throw Error("written for the Principled dialect '" + weights_.dialect + "', not '" + DIALECT + "'");
        if (weights_.instances > MAX_INSTANCES)
            throw Error("a blend of more than " + std::to_string(MAX_INSTANCES) + " instances");
        if (weights_.layers.front().in != recipe_.encoding.size() || weights_.layers.back().out != output_count())
            throw Error("the network does not fit its description; train again");
    }

    // The ranges of all outputs, of instance after instance; shares of the blend lie in 0 .. 1.
    void lay_out_ranges() {
        const int count = network_.output_stride();
        ranges_ = detail::aligned<float>(5 * static_cast<std::size_t>(count));
        float *start = ranges_.get(), *slope = start + count, *factor = slope + count;
        float *rate = factor + count, *in_plane = rate + count;
        recipe_.ranges = {count, 0, start, slope, factor, rate, in_plane};
        int next = 0;
        for (int k = 0; k < weights_.instances; ++k)
            for (const TargetParam& p : weights_.target)
                for (int c = 0; c < p.size; ++c, ++next) {
                    in_plane[next] = p.in_plane;
                    (p.logarithmic ? factor : start)[next] = static_cast<float>(p.low);
                    (p.logarithmic ? rate : slope)[next] =
                        static_cast<float>(p.logarithmic ? std::log2(p.high / p.low) : p.high - p.low);
                    if (p.logarithmic) recipe_.ranges.logarithmic = next + 1;
                }
        std::fill(slope + next, slope + output_count(), 1.0f);
    }

    void lay_out_lanes() {
        const int size = static_cast<int>(fields_.size()), per_pack = Blend<float>::FIELDS * LANES;
        lanes_.assign(static_cast<std::size_t>(per_pack) * MAX_PACKS, output_count());
        for (int k = 0; k < weights_.instances; ++k)
            for (int f = 0; f < size; ++f) lanes_[k / LANES * per_pack + fields_[f] * LANES + k % LANES] = k * size + f;
        recipe_.lanes = lanes_.data();
    }

    // Isotropic adapters do not look at what would cost them a root.
    Direction at_azimuth_0(float cos_theta_i) const {
        return {anisotropic() ? safe_sqrt(1.0f - cos_theta_i * cos_theta_i) : 0.0f, 0.0f, cos_theta_i};
    }

    // Calls `work(first, count, wi)` for blocks of queries, whose first is the number `first` of all.
    template <class Work>
    void in_blocks(int count, const float* cos_theta_i, const Work& work) const {
        Direction wi[BLOCK];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            std::transform(cos_theta_i + first, cos_theta_i + first + now, wi,
                           [&](float cosine) { return at_azimuth_0(cosine); });
            work(first, now, wi);
        }
    }

    // The parameters of query `q`.
    const float* row(const float* parameters, int q) const {
        return parameters + static_cast<std::size_t>(q) * parameter_count();
    }

    void outputs_of_block(int count, const float* parameters, const Direction* wi, float* outputs) const {
        alignas(64) float inputs[BLOCK * WIDEST_LAYER];
        for (int q = 0; q < count; ++q)
            kernels().encode(recipe_, row(parameters, q), wi[q], inputs + q * network_.input_stride());
        network_.forward_many(count, inputs, outputs);
    }

    Weights weights_;
    Network network_;
    Recipe recipe_{};
    std::vector<int> fields_, lanes_;
    std::vector<std::size_t> owners_;
    std::unique_ptr<float[], detail::FreeAligned> ranges_;
    bool in_plane_ = false;
};

// The blends of an untextured material over cos(theta_i), interpolated between nodes: no network at the shading point.
// Of isotropic adapters only.
class Curves {
public:
    // As many as nma/render/curves.py has, and the cosine that it takes for those below.
    static constexpr int NODES = 128;
    static constexpr float MIN_COS = 1e-4f;

    // Throws `Error` for anisotropic adapters.
    Curves(const Adapter& adapter, const float* parameters, int nodes = NODES) {
        if (adapter.anisotropic())
            throw Error(
                "an anisotropic adapter has no curves, as the azimuth of the view matters; prepare by direction");
        for (int n = 0; n < std::max(nodes, 2); ++n) {
            const float cosine = static_cast<float>(n) / static_cast<float>(std::max(nodes, 2) - 1);
            nodes_.push_back(adapter.prepare(parameters, maximum(cosine, MIN_COS)));
        }
    }

    // Weights and odds of both neighbours sum to one, and so do those between them.
    Brdf at(float cos_theta_i) const {
        const float position = clip(cos_theta_i, 0.0f, 1.0f) * static_cast<float>(nodes_.size() - 1);
        const std::size_t left = std::min(static_cast<std::size_t>(position), nodes_.size() - 2);
        const Lanes<float> t = position - static_cast<float>(left);
        const Blend<float>& a = nodes_[left].blend_;
        const Blend<float>& b = nodes_[left + 1].blend_;
        Brdf made;
        made.in_plane_ = nodes_[left].in_plane_;
        made.blend_.count = a.count;
        made.blend_.scale = a.scale + (b.scale - a.scale) * t[0];
        for (int n = 0; n < a.used(); ++n) {
            const Lanes<float>* from = a.packs[n].lanes();
            const Lanes<float>* to = b.packs[n].lanes();
            Lanes<float>* between = made.blend_.packs[n].lanes();
            for (std::size_t k = 0; k < sizeof(Pack<float>) / sizeof(Lanes<float>); ++k)
                between[k] = lerp(from[k], to[k], t);
        }
        return made;
    }

private:
    std::vector<Brdf> nodes_;
};

// Batches of `Brdf::eval_pdf` and `Brdf::sample`; `u` holds three uniform numbers for each.
inline void eval_pdf_many(int count, const Brdf* brdfs, const Direction* wi, const Direction* wo, Value* values) {
    for (int k = 0; k < count; ++k) values[k] = brdfs[k].eval_pdf(wi[k], wo[k]);
}
inline void sample_many(int count, const Brdf* brdfs, const Direction* wi, const float* u, Sampled* samples) {
    for (int k = 0; k < count; ++k, u += 3) samples[k] = brdfs[k].sample(wi[k], u[0], u[1], u[2]);
}

}  // namespace nma
