// Neural Material Adapter: expensive materials rendered as blends of Principled BRDFs that a tiny network prepares.
//
//     const nma::Adapter adapter = nma::Adapter::load("layered3-5x64.safetensors");
//     const nma::Material at_hit = adapter.prepare(parameters, cos_theta_i);     // once per shading point
//     const nma::Value v = at_hit.eval(wi, wo);                                  // f cos(theta_o) [1/sr] and pdf [1/sr]
//     const nma::Sampled s = at_hit.sample(wi, u_lobe, u1, u2);
//
// C++17, no dependencies. Loading allocates and throws `nma::Error`; everything else does neither and is safe to call
// from many threads at once. Directions are unit vectors in the local frame, z up, `wi` towards the viewer, `wo` towards
// the light. Lobes of adapters with `in_plane` parameters are stretched along the plane of incidence, which is found here.
#pragma once

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

class Adapter {
public:
    static constexpr const char* DIALECT = "mitsuba-principled-reflection";

    static Adapter load(const std::string& path) {
        try {
            const std::string bytes = read_file(path);
            return from_memory(bytes.data(), bytes.size());
        } catch (const Error& e) {
            throw Error(path + ": " + e.what());
        }
    }

    static Adapter from_memory(const void* bytes, std::size_t size) { return Adapter(parse_weights(bytes, size)); }

    // Numbers that `prepare` takes, in the order of `parameters`.
    int parameter_count() const { return parameter_count_; }
    const std::vector<SourceParam>& parameters() const { return weights_.parameters; }

    // The blend for the parameters of the source material at cos(theta_i).
    Material prepare(const float* parameters, float cos_theta_i) const {
        alignas(64) float raw[WIDEST_LAYER];
        network_outputs(parameters, cos_theta_i, raw);
        Material made;
        made.prepared_ = nma::prepare(decode(raw, cos_theta_i), cos_theta_i, weights_.bounded);
        made.in_plane_ = in_plane_;
        return made;
    }

    // What the network returns, before decoding; `raw` has room for WIDEST_LAYER numbers.
    void network_outputs(const float* parameters, float cos_theta_i, float* raw) const {
        float inputs[WIDEST_LAYER];
        encode(parameters, cos_theta_i, inputs);
        network_.forward(inputs, raw);
    }

private:
    enum class Encoding { Raw, Direction, Layered3 };

    // Where a number of the network goes, and its range.
    struct Field {
        float Principled<float>::*scalar;  // null for channels of the base colour
        float Vec3<float>::*channel;
        float low, span;  // of a logarithmic one the factor, and the logarithm of the ratio of its ends
        bool logarithmic, in_plane;
    };

    explicit Adapter(Weights weights) : weights_(std::move(weights)), network_(weights_.layers) {
        for (const SourceParam& p : weights_.parameters) parameter_count_ += p.size;
        for (const TargetParam& p : weights_.target) add_fields(p);
        encoding_ = encoding_named(weights_.encoding);
        check();
    }

    static Encoding encoding_named(const std::string& name) {
        if (name == "raw") return Encoding::Raw;
        if (name == "direction") return Encoding::Direction;
        if (name == "layered3") return Encoding::Layered3;
        throw Error("unknown input encoding '" + name + "'; upgrade the runtime");
    }

    void add_fields(const TargetParam& p) {
        using P = Principled<float>;
        static constexpr std::pair<const char*, float P::*> SCALARS[] = {
            {"roughness", &P::roughness}, {"metallic", &P::metallic}, {"specular", &P::specular},
            {"spec_tint", &P::spec_tint}, {"sheen", &P::sheen}, {"sheen_tint", &P::sheen_tint},
            {"clearcoat", &P::clearcoat}, {"clearcoat_gloss", &P::clearcoat_gloss},
            {"anisotropic", &P::anisotropic}, {"flatness", &P::flatness}};
        const double span = p.logarithmic ? std::log(p.high / p.low) : p.high - p.low;
        Field field{nullptr, nullptr, static_cast<float>(p.low), static_cast<float>(span), p.logarithmic, p.in_plane};
        in_plane_ |= p.in_plane;
        if (p.name == "base_color" && p.size == 3) {
            for (const auto channel : {&Vec3<float>::x, &Vec3<float>::y, &Vec3<float>::z}) {
                field.channel = channel;
                fields_.push_back(field);
            }
            return;
        }
        for (const auto& [name, scalar] : SCALARS)
            if (p.name == name && p.size == 1) field.scalar = scalar;
        if (!field.scalar) throw Error("unknown target parameter '" + p.name + "'; upgrade the runtime");
        fields_.push_back(field);
    }

    // Refuses a network that does not fit its own description, or this version's target.
    void check() const {
        if (weights_.dialect != DIALECT) throw Error("written for the Principled dialect '" + weights_.dialect + "', not '" + DIALECT + "'");
        if (weights_.instances > MAX_INSTANCES) throw Error("a blend of more than " + std::to_string(MAX_INSTANCES) + " instances");
        const int expected = encoding_ == Encoding::Direction ? 1 : encoding_ == Encoding::Raw ? parameter_count_ + weights_.directional
                                                                                                : 13 + 3 * weights_.directional;
        const int size = static_cast<int>(fields_.size()) * weights_.instances + weights_.instances - 1;
        if (encoding_ == Encoding::Layered3 && (parameter_count_ != 13 || weights_.parameters.size() != 7)) throw Error("the encoding 'layered3' belongs to another class");
        if (weights_.layers.front().in != expected || weights_.layers.back().out != size)
            throw Error("the network does not fit its description; train again");
    }

    // Twin of nma/encoding.py.
    void encode(const float* p, float cosine, float* x) const {
        if (encoding_ == Encoding::Direction) {
            x[0] = weights_.directional ? 2.0f * cosine - 1.0f : 1.0f;
        } else if (encoding_ == Encoding::Raw) {
            x = std::copy_n(p, parameter_count_, x);
            if (weights_.directional) *x = cosine;
        } else {
            encode_layered3(p, cosine, x);
        }
    }

    void encode_layered3(const float* p, float cosine, float* x) const {
        constexpr float GRAZING = 0.1045f;
        const float *eta = p + 3, *k = p + 6, *albedo = p + 9;
        const float eta_top = p[2], sigma_t = p[12];
        const auto& declared = weights_.parameters;
        float* next = x;
        *next++ = normalised(declared[0], p[0]);
        *next++ = normalised(declared[1], p[1]);
        *next++ = normalised(declared[2], eta_top);
        *next++ = normalised(declared[6], sigma_t);
        for (const float angle : {1.0f, GRAZING})
            for (int c = 0; c < 3; ++c) *next++ = fresnel_conductor<float>(angle, eta[c] / eta_top, k[c] / eta_top);
        for (int c = 0; c < 3; ++c) *next++ = albedo[c];
        if (weights_.directional) {
            const auto [fresnel, cos_t] = fresnel_dielectric<float>(cosine, eta_top);
            *next++ = cosine;
            *next++ = fresnel;
            *next++ = std::exp(-sigma_t / maximum(cos_t, 0.05f));
        }
        for (float* unit = x; unit != next; ++unit) *unit = 2.0f * *unit - 1.0f;
    }

    static float normalised(const SourceParam& p, float value) {
        const float low = static_cast<float>(p.low);
        if (p.logarithmic) return std::log(value / low) * static_cast<float>(1.0 / std::log(p.high / p.low));
        return (value - low) / static_cast<float>(p.high - p.low);
    }

    // Twin of nma/target/decode.py.
    Blend<float> decode(const float* raw, float cosine) const {
        Blend<float> made;
        made.count = weights_.instances;
        const float fade = 1.0f - cosine * cosine;
        for (int k = 0; k < made.count; ++k) {
            Principled<float>& instance = made.instances[k] = {};
            for (const Field& field : fields_) {
                float value = sigmoid(*raw++);
                value = field.logarithmic ? field.low * std::exp(field.span * value) : field.low + field.span * value;
                if (field.in_plane) value *= fade;
                if (field.scalar) instance.*field.scalar = value;
                else instance.base_color.*field.channel = value;
            }
        }
        float left = 1.0f;
        for (int k = 0; k + 1 < made.count; ++k) {
            const float share = sigmoid(*raw++);
            made.weights[k] = left * share;
            left *= 1.0f - share;
        }
        made.weights[made.count - 1] = left;
        return made;
    }

    static float sigmoid(float x) { return 0.5f + 0.5f * std::tanh(0.5f * x); }

    Weights weights_;
    Network network_;
    std::vector<Field> fields_;
    Encoding encoding_ = Encoding::Raw;
    int parameter_count_ = 0;
    bool in_plane_ = false;
};

}  // namespace nma
