// Neural Material Adapter: expensive materials rendered as blends of Principled BRDFs that a tiny network prepares.
//
//     const nma::Adapter adapter = nma::Adapter::load("layered3-5x64.safetensors");
//     const nma::Material at_hit = adapter.prepare(parameters, cos_theta_i);     // once per shading point
//     const nma::Value v = at_hit.eval(wi, wo);                                  // f cos(theta_o) [1/sr] and pdf [1/sr]
//     const nma::Sampled s = at_hit.sample(wi, u_lobe, u1, u2);
//
// C++17, no dependencies. The network runs on the widest vectors of the CPU at hand (`InstructionSet`). Loading allocates and throws `nma::Error`; everything else does neither and is safe to call
// from many threads at once. Directions are unit vectors in the local frame, z up, `wi` towards the viewer, `wo` towards
// the light. Lobes of adapters with `in_plane` parameters are stretched along the plane of incidence, which is found here.
#pragma once

#include <cstddef>

#include "nma/blend.h"
#include "nma/network.h"
#include "nma/weights.h"

namespace nma {

using Direction = Vec3<float>;
using Value = Evaluation<float>;
using Sampled = Sample<float>;

// The material at one shading point, for the cos(theta_i) it was prepared for.
class Material {
public:
    // f cos(theta_o) [1/sr] and the density of `sample` [1/sr], both 0 below the horizon.
    Value eval(const Direction& wi, const Direction& wo) const {
        const Plane plane = Plane::of(wi, in_plane_);
        return eval_pdf(prepared_, plane.enter(wi), plane.enter(wo));
    }

    float pdf(const Direction& wi, const Direction& wo) const { return eval(wi, wo).pdf; }

    // A direction from three uniform numbers in [0, 1), with its value and density; pdf == 0 marks an invalid one.
    Sampled sample(const Direction& wi, float u_lobe, float u1, float u2) const {
        const Plane plane = Plane::of(wi, in_plane_);
        Sampled found = nma::sample(prepared_, plane.enter(wi), u_lobe, u1, u2);
        found.wo = plane.leave(found.wo);
        return found;
    }

    const Blend<float>& blend() const { return prepared_.blend; }

private:
    friend class Adapter;
    friend class Curves;

    // Rotation about z into the frame whose x axis lies in the plane of incidence. Twin of nma/target/plane.py.
    struct Plane {
        float cos_phi, sin_phi;

        static Plane of(const Direction& wi, bool wanted) {
            const float length = std::sqrt(wi.x * wi.x + wi.y * wi.y);
            return wanted && length > 0.0f ? Plane{wi.x / length, wi.y / length} : Plane{1.0f, 0.0f};
        }
        Direction enter(const Direction& v) const { return {cos_phi * v.x + sin_phi * v.y, cos_phi * v.y - sin_phi * v.x, v.z}; }
        Direction leave(const Direction& v) const { return {cos_phi * v.x - sin_phi * v.y, sin_phi * v.x + cos_phi * v.y, v.z}; }
    };

    Prepared<float> prepared_;
    bool in_plane_ = false;
};

// How a weights file is loaded.
struct Options {
    // All but avx512_bf16 compute in float32; that one halves a network's time by rounding activations to 8 bits.
    InstructionSet set = fastest();
    // Rounds weights to bfloat16, which halves the memory that a query has to fetch. Both shipped adapters lost less than
    // .00002 of log loss by it; avx512_bf16 always does it.
    bool compact = false;
};

class Adapter {
public:
    static constexpr const char* DIALECT = "mitsuba-principled-reflection";
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

    static Adapter from_memory(const void* bytes, std::size_t size, const Options& options = {}) { return Adapter(parse_weights(bytes, size), options); }

    // Numbers that `prepare` takes, in the order of `parameters`.
    int parameter_count() const { return parameter_count_; }
    const std::vector<SourceParam>& parameters() const { return weights_.parameters; }
    // Numbers that describe a blend, and what the network returns for them.
    int output_count() const { return output_count_; }
    InstructionSet instruction_set() const { return network_.instruction_set(); }

    // The blend for the parameters of the source material at cos(theta_i).
    Material prepare(const float* parameters, float cos_theta_i) const {
        alignas(64) float numbers[WIDEST_LAYER];
        network_outputs(parameters, cos_theta_i, numbers);
        return decoded(numbers, cos_theta_i);
    }

    // The same for many shading points, whose parameters are rows: queries share the loads of the weights.
    void prepare_many(int count, const float* parameters, const float* cos_theta_i, Material* materials) const {
        alignas(64) float outputs[BLOCK * WIDEST_LAYER];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            outputs_of_block(now, parameters + static_cast<std::size_t>(first) * parameter_count_, cos_theta_i + first, outputs);
            for (int q = 0; q < now; ++q) materials[first + q] = decoded(outputs + q * network_.output_stride(), cos_theta_i[first + q]);
        }
    }

    // What the network returns, before decoding; `raw` is aligned to 64 bytes and has room for WIDEST_LAYER numbers.
    void network_outputs(const float* parameters, float cos_theta_i, float* raw) const {
        alignas(64) float inputs[WIDEST_LAYER];
        encode(parameters, cos_theta_i, inputs);
        network_.forward(inputs, raw);
    }

    // Likewise for many, rows of `output_count` numbers.
    void network_outputs_many(int count, const float* parameters, const float* cos_theta_i, float* raw) const {
        alignas(64) float outputs[BLOCK * WIDEST_LAYER];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            outputs_of_block(now, parameters + static_cast<std::size_t>(first) * parameter_count_, cos_theta_i + first, outputs);
            for (int q = 0; q < now; ++q)
                std::copy_n(outputs + q * network_.output_stride(), output_count_, raw + static_cast<std::size_t>(first + q) * output_count_);
        }
    }

private:
    friend class Curves;

    enum class Encoding { Raw, Direction, Layered3 };

    Adapter(Weights weights, const Options& options) : weights_(std::move(weights)), network_(weights_.layers, options.set, options.compact) {
        for (const SourceParam& p : weights_.parameters) parameter_count_ += p.size;
        for (const TargetParam& p : weights_.target) add_fields(p);
        encoding_ = encoding_named(weights_.encoding);
        output_count_ = static_cast<int>(offsets_.size()) * weights_.instances + weights_.instances - 1;
        check();
        lay_out_ranges();
        weights_.layers.clear();
    }

    static Encoding encoding_named(const std::string& name) {
        if (name == "raw") return Encoding::Raw;
        if (name == "direction") return Encoding::Direction;
        if (name == "layered3") return Encoding::Layered3;
        throw Error("unknown input encoding '" + name + "'; upgrade the runtime");
    }

    // Remembers where in a `Principled` the numbers of a parameter go.
    void add_fields(const TargetParam& p) {
        using P = Principled<float>;
        static constexpr std::pair<const char*, std::size_t> FIELDS[] = {
            {"base_color", offsetof(P, base_color)}, {"roughness", offsetof(P, roughness)}, {"metallic", offsetof(P, metallic)},
            {"specular", offsetof(P, specular)}, {"spec_tint", offsetof(P, spec_tint)}, {"sheen", offsetof(P, sheen)},
            {"sheen_tint", offsetof(P, sheen_tint)}, {"clearcoat", offsetof(P, clearcoat)}, {"clearcoat_gloss", offsetof(P, clearcoat_gloss)},
            {"anisotropic", offsetof(P, anisotropic)}, {"flatness", offsetof(P, flatness)}};
        in_plane_ |= p.in_plane;
        for (const auto& [name, offset] : FIELDS)
            if (p.name == name && p.size == (p.name == "base_color" ? 3 : 1)) {
                for (int c = 0; c < p.size; ++c) offsets_.push_back(offset + c * sizeof(float));
                return;
            }
        throw Error("unknown target parameter '" + p.name + "'; upgrade the runtime");
    }

    // Refuses a network that does not fit its own description, or this version's target.
    void check() const {
        if (weights_.dialect != DIALECT) throw Error("written for the Principled dialect '" + weights_.dialect + "', not '" + DIALECT + "'");
        if (weights_.instances > MAX_INSTANCES) throw Error("a blend of more than " + std::to_string(MAX_INSTANCES) + " instances");
        const int expected = encoding_ == Encoding::Direction ? 1 : encoding_ == Encoding::Raw ? parameter_count_ + weights_.directional
                                                                                                : 13 + 3 * weights_.directional;
        if (encoding_ == Encoding::Layered3 && (parameter_count_ != 13 || weights_.parameters.size() != 7)) throw Error("the encoding 'layered3' belongs to another class");
        if (weights_.layers.front().in != expected || weights_.layers.back().out != output_count_)
            throw Error("the network does not fit its description; train again");
    }

    // The ranges of all outputs, of instance after instance; shares of the blend lie in 0 .. 1.
    void lay_out_ranges() {
        const int count = network_.output_stride();
        ranges_memory_ = detail::aligned<float>(4 * static_cast<std::size_t>(count));
        float *low = ranges_memory_.get(), *span = low + count, *log = span + count, *in_plane = log + count;
        ranges_ = {count, false, low, span, log, in_plane};
        int next = 0;
        for (int k = 0; k < weights_.instances; ++k)
            for (const TargetParam& p : weights_.target)
                for (int c = 0; c < p.size; ++c, ++next) {
                    low[next] = static_cast<float>(p.low);
                    span[next] = static_cast<float>(p.logarithmic ? std::log(p.high / p.low) : p.high - p.low);
                    log[next] = p.logarithmic;
                    in_plane[next] = p.in_plane;
                    ranges_.any_log |= p.logarithmic;
                }
        std::fill(span + next, span + count, 1.0f);
    }

    void outputs_of_block(int count, const float* parameters, const float* cos_theta_i, float* outputs) const {
        alignas(64) float inputs[BLOCK * WIDEST_LAYER];
        for (int q = 0; q < count; ++q) encode(parameters + q * parameter_count_, cos_theta_i[q], inputs + q * network_.input_stride());
        network_.forward_many(count, inputs, outputs);
    }

    // Twin of nma/encoding.py. Inputs beyond the encoding's own, up to the network's stride, become 0.
    void encode(const float* p, float cosine, float* x) const {
        float* const end = x + network_.input_stride();
        if (encoding_ == Encoding::Direction) {
            *x++ = weights_.directional ? 2.0f * cosine - 1.0f : 1.0f;
        } else if (encoding_ == Encoding::Raw) {
            x = std::copy_n(p, parameter_count_, x);
            if (weights_.directional) *x++ = cosine;
        } else {
            x = encode_layered3(p, cosine, x);
        }
        std::fill(x, end, 0.0f);
    }

    float* encode_layered3(const float* p, float cosine, float* x) const {
        constexpr float GRAZING = 0.1045f;
        const float *eta = p + 3, *k = p + 6, *albedo = p + 9;
        const float eta_top = p[2], sigma_t = p[12];
        const auto& declared = weights_.parameters;
        float* next = x;
        *next++ = normalised(declared[0], p[0]);
        *next++ = normalised(declared[1], p[1]);
        *next++ = normalised(declared[2], eta_top);
        *next++ = normalised(declared[6], sigma_t);
        const float inside = 1.0f / eta_top;
        for (int c = 0; c < 3; ++c) {
            // At normal incidence |n - 1|^2 / |n + 1|^2, which is what fresnel_conductor comes to there.
            const float n = eta[c] * inside, k2 = k[c] * inside * (k[c] * inside);
            next[c] = ((n - 1.0f) * (n - 1.0f) + k2) / ((n + 1.0f) * (n + 1.0f) + k2);
            next[c + 3] = fresnel_conductor<float>(GRAZING, n, k[c] * inside);
        }
        next += 6;
        for (int c = 0; c < 3; ++c) *next++ = albedo[c];
        if (weights_.directional) {
            const auto [fresnel, cos_t] = fresnel_dielectric<float>(cosine, eta_top);
            *next++ = cosine;
            *next++ = fresnel;
            *next++ = std::exp(-sigma_t / maximum(cos_t, 0.05f));
        }
        for (float* unit = x; unit != next; ++unit) *unit = 2.0f * *unit - 1.0f;
        return next;
    }

    static float normalised(const SourceParam& p, float value) { return ((p.logarithmic ? std::log(value) : value) - p.start) * p.per_range; }

    // The material of the network's outputs, which become its numbers. Twin of nma/target/decode.py.
    Material decoded(float* raw, float cosine) const {
        network_.kernels_in_use().decode(ranges_, raw, 1.0f - cosine * cosine);
        return material(raw, cosine);
    }

    // From the numbers of all instances and the shares of the blend.
    Material material(const float* numbers, float cosine) const {
        Material made;
        Blend<float>& blend = made.prepared_.blend;
        blend.count = weights_.instances;
        for (int k = 0; k < blend.count; ++k) {
            Principled<float>& instance = blend.instances[k];
            instance.anisotropic = instance.flatness = 0.0f;
            for (const std::size_t offset : offsets_) std::memcpy(reinterpret_cast<char*>(&instance) + offset, numbers++, sizeof(float));
        }
        float left = 1.0f;
        for (int k = 0; k + 1 < blend.count; ++k) {
            const float share = *numbers++;
            blend.weights[k] = left * share;
            left *= 1.0f - share;
        }
        blend.weights[blend.count - 1] = left;
        weigh(made.prepared_, cosine, weights_.bounded);
        made.in_plane_ = in_plane_;
        return made;
    }

    Weights weights_;
    Network network_;
    std::vector<std::size_t> offsets_;
    std::unique_ptr<float[], detail::FreeAligned> ranges_memory_;
    Ranges ranges_{};
    Encoding encoding_ = Encoding::Raw;
    int parameter_count_ = 0, output_count_ = 0;
    bool in_plane_ = false;
};

// The blends of an untextured material over cos(theta_i), interpolated between nodes: no network at the shading point.
class Curves {
public:
    // As many as nma/render/curves.py has.
    static constexpr int NODES = 128;

    Curves(const Adapter& adapter, const float* parameters, int nodes = NODES) : adapter_(&adapter), nodes_(std::max(nodes, 2)) {
        const int stride = adapter.network_.output_stride();
        numbers_.resize(static_cast<std::size_t>(nodes_) * stride);
        alignas(64) float raw[WIDEST_LAYER];
        for (int n = 0; n < nodes_; ++n) {
            const float cosine = maximum(static_cast<float>(n) / static_cast<float>(nodes_ - 1), 1e-4f);
            adapter.network_outputs(parameters, cosine, raw);
            adapter.network_.kernels_in_use().decode(adapter.ranges_, raw, 1.0f - cosine * cosine);
            std::copy_n(raw, stride, numbers_.begin() + static_cast<std::ptrdiff_t>(n) * stride);
        }
    }

    // The adapter must outlive the curves.
    Material at(float cos_theta_i) const {
        const int stride = adapter_->network_.output_stride();
        const float position = clip(cos_theta_i, 0.0f, 1.0f) * static_cast<float>(nodes_ - 1);
        const int left = std::min(static_cast<int>(position), nodes_ - 2);
        const float t = position - static_cast<float>(left);
        const float *a = numbers_.data() + static_cast<std::ptrdiff_t>(left) * stride, *b = a + stride;
        float numbers[WIDEST_LAYER];
        for (int k = 0; k < stride; ++k) numbers[k] = lerp(a[k], b[k], t);
        return adapter_->material(numbers, cos_theta_i);
    }

private:
    const Adapter* adapter_;
    int nodes_;
    std::vector<float> numbers_;
};

// Batches of `Material::eval` and `Material::sample`; `u` holds three uniform numbers for each.
inline void eval_many(int count, const Material* materials, const Direction* wi, const Direction* wo, Value* values) {
    for (int k = 0; k < count; ++k) values[k] = materials[k].eval(wi[k], wo[k]);
}
inline void sample_many(int count, const Material* materials, const Direction* wi, const float* u, Sampled* samples) {
    for (int k = 0; k < count; ++k, u += 3) samples[k] = materials[k].sample(wi[k], u[0], u[1], u[2]);
}

}  // namespace nma
