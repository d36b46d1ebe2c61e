// The network's inputs: a material's parameters and the view direction as numbers of about unit size. Twin of
// nma/adapter/encoding.py.
#pragma once

#include "constants.h"
#include "kernels/macros.h"
#include "lanes.h"
#include "target.h"
#include "weights.h"

namespace nma {

class Encoding {
public:
    Encoding() = default;

    explicit Encoding(const Weights& weights) : kind_(kind_named(weights.encoding)), directional_(weights.directional) {
        for (const SourceParam& p : weights.parameters) parameters_ += p.size;
        if (kind_ != Kind::Layered3) return;
        if (parameters_ != layered3::COLUMNS) throw Error("the encoding 'layered3' belongs to another class");
        int k = 0;
        for (const char* name : {"alpha_top", "alpha_bottom", "eta_top", "sigma_t"}) {
            const SourceParam& p = scalar(weights, name);
            log_.set(k, p.logarithmic);
            start_.set(k, p.start);
            per_range_.set(k++, p.per_range);
        }
    }

    // How many parameters it takes, and how many inputs the network was trained on.
    int parameters() const { return parameters_; }
    int size() const {
        switch (kind_) {
            case Kind::Raw:
                return parameters_ + directional_;
            case Kind::Direction:
                return 1;
            case Kind::Azimuth:
                return 5;
            default:
                return 13 + 3 * directional_;
        }
    }
    // Whether the view's azimuth matters: `encode` reads all of wi, otherwise wi.z alone.
    bool anisotropic() const { return kind_ == Kind::Azimuth; }

    // The network's first layer for numbers in the order of `encode`.
    Layer arranged(const Layer& first) const {
        if (kind_ != Kind::Layered3) return first;
        Layer made{4 * LANES, first.out, std::vector<float>(4 * LANES * static_cast<std::size_t>(first.out)),
                   first.bias};
        for (int j = 0; j < first.out; ++j)
            for (int i = 0; i < first.in; ++i) made.matrix[j * made.in + place(i)] = first.matrix[j * first.in + i];
        return made;
    }

    // `x` is padded with zeros to `stride`.
    void encode(const float* p, const Vec3<float>& wi, float* x, int stride) const {
        if (kind_ == Kind::Layered3) return layered3(p, wi.z, x);
        float* const end = x + stride;
        if (kind_ == Kind::Raw) {
            x = std::copy_n(p, parameters_, x);
            if (directional_) *x++ = wi.z;
        } else {
            *x++ = directional_ ? 2.0f * wi.z - 1.0f : 1.0f;
            if (kind_ == Kind::Azimuth) x = azimuth(wi, x);
        }
        std::fill(x, end, 0.0f);
    }

private:
    enum class Kind { Raw, Direction, Azimuth, Layered3 };

    static Kind kind_named(const std::string& name) {
        if (name == "raw") return Kind::Raw;
        if (name == "direction") return Kind::Direction;
        if (name == "azimuth") return Kind::Azimuth;
        if (name == "layered3") return Kind::Layered3;
        throw Error("unknown input encoding '" + name + "'; upgrade the runtime");
    }

    static const SourceParam& scalar(const Weights& weights, const char* name) {
        for (const SourceParam& p : weights.parameters)
            if (p.name == name && p.size == 1) return p;
        throw Error("the encoding 'layered3' belongs to another class");
    }

    // The lane of input `i`: four scalars, then three colours, whose fourth lanes hold what depends on the direction.
    static int place(int i) { return i < 4 ? i : i < 13 ? 4 + (i - 4) / 3 * 4 + (i - 4) % 3 : 4 * (i - 13) + 7; }

    // The azimuth once and twice. Both fade towards normal incidence, where there is no azimuth. Returns their end.
    static float* azimuth(const Vec3<float>& wi, float* x) {
        const float numbers[] = {wi.x, wi.y, wi.x * wi.x - wi.y * wi.y, 2.0f * wi.x * wi.y};
        return std::copy_n(numbers, 4, x);
    }

    NMA_INLINE void layered3(const float* p, float cosine, float* x) const {
        using Four = Lanes<float>;
        const float sigma_t = p[layered3::SIGMA_T], eta_top = p[layered3::ETA_TOP];
        // What takes longest comes first.
        const auto [fresnel, cos_t] = fresnel_dielectric<float>(cosine, eta_top);
        const Four transmitted = exp(maximum(Four(-sigma_t / maximum(cos_t, MIN_COS_T)), Four(-87.0f)));
        const Four one(1.0f), inside(1.0f / eta_top);
        const Four n = four(p + layered3::ETA_CONDUCTOR) * inside, k = four(p + layered3::K_CONDUCTOR) * inside;
        const Four k2 = k * k, less = n - one, more = n + one;
        Four grazing = fresnel_conductor<Four>(Four(GRAZING), n, k);
        // At normal incidence fresnel_conductor is |n - 1|^2 / |n + 1|^2.
        Four normal = (less * less + k2) / (more * more + k2), albedo = four(p + layered3::ALBEDO);
        const Four plain{p[layered3::ALPHA_TOP], p[layered3::ALPHA_BOTTOM], eta_top, sigma_t};
        const Four bent = plain + (log(maximum(plain, Four(1e-30f))) - plain) * log_;
        normal.set(3, directional_ ? cosine : 0.0f);
        grazing.set(3, directional_ ? fresnel : 0.0f);
        albedo.set(3, directional_ ? transmitted[0] : 0.0f);
        put(x, (bent - start_) * per_range_);
        put(x + LANES, normal);
        put(x + 2 * LANES, grazing);
        put(x + 3 * LANES, albedo);
    }

    // Four numbers, from 0 .. 1 to -1 .. 1.
    static void put(float* x, const Lanes<float>& units) {
        const Lanes<float> spread = units * Lanes<float>(2.0f) - Lanes<float>(1.0f);
        std::memcpy(x, &spread, sizeof(spread));
    }

    static Lanes<float> four(const float* p) {
        Lanes<float> found;
        std::memcpy(&found, p, sizeof(found));
        return found;
    }

    Kind kind_ = Kind::Raw;
    bool directional_ = false;
    int parameters_ = 0;
    // How the four scalar parameters of `layered3` become units.
    Lanes<float> log_{0.0f}, start_{0.0f}, per_range_{0.0f};
};

}  // namespace nma
