// Computes the inputs of the network, which are numbers of about unit size, from the parameters of a material and the
// view direction. nma/adapter/encoding.py is the Python version of this code.
#pragma once

#include "generated/constants.h"
#include "generated/target.h"
#include "kernels/macros.h"
#include "lanes.h"
#include "weights.h"

namespace nma {

class Encoding {
public:
    Encoding() = default;

    explicit Encoding(const Weights& weights) : kind_(kind_named(weights.encoding)), directional_(weights.directional) {
        for (const SourceParam& p : weights.parameters) parameters_ += p.size;
        if (kind_ != Kind::Layered3) return;
        if (parameters_ != layered3::COLUMNS) throw Error(WRONG_CLASS);
        int k = 0;
        for (const char* name : {"alpha_top", "alpha_bottom", "eta_top", "sigma_t"}) {
            const SourceParam& p = scalar(weights, name);
            log_.set(k, p.logarithmic);
            start_.set(k, p.start);
            per_range_.set(k++, p.per_range);
        }
    }

    // The count of numbers that `encode` reads as the parameters of a material.
    int parameters() const { return parameters_; }
    // The count of inputs that the network was trained on.
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
    // Whether the inputs depend on the azimuth of `wi`. If the azimuth does not matter, `encode` reads only wi.z.
    bool anisotropic() const { return kind_ == Kind::Azimuth; }

    // Reorders the inputs of `first`, the first layer of a file, to the order in which `encode` writes them. The orders
    // differ only for the encoding `layered3`: see `place`.
    Layer arranged(const Layer& first) const {
        if (kind_ != Kind::Layered3) return first;
        Layer made{4 * LANES, first.out, std::vector<float>(4 * LANES * static_cast<std::size_t>(first.out)),
                   first.bias};
        for (int j = 0; j < first.out; ++j)
            for (int i = 0; i < first.in; ++i) made.matrix[j * made.in + place(i)] = first.matrix[j * first.in + i];
        return made;
    }

    // Writes the inputs for the parameters `p` to `x`, and fills `x` with zeros up to `stride` numbers.
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
    static constexpr const char* WRONG_CLASS =
        "the encoding 'layered3' does not fit the parameters of its class; train again";

    static Kind kind_named(const std::string& name) {
        if (name == "raw") return Kind::Raw;
        if (name == "direction") return Kind::Direction;
        if (name == "azimuth") return Kind::Azimuth;
        if (name == "layered3") return Kind::Layered3;
        throw Error("unknown input encoding '" + shown(name) + "'; upgrade the runtime");
    }

    // The parameter called `name`. Throws unless this parameter exists and has one number.
    static const SourceParam& scalar(const Weights& weights, const char* name) {
        for (const SourceParam& p : weights.parameters)
            if (p.name == name && p.size == 1) return p;
        throw Error(WRONG_CLASS);
    }

    // The position to which `encode` writes input i of the encoding `layered3`. The network was trained with its inputs
    // in this order: four scalars s0 .. s3, three colours (r, g, b), and three numbers d0 .. d2 that depend on the
    // direction. `encode` computes vectors of four lanes, so it appends one of the numbers d0 .. d2 to each colour:
    //
    //     order of training    s0 s1 s2 s3  r0 g0 b0  r1 g1 b1  r2 g2 b2  d0 d1 d2
    //     order of `encode`    s0 s1 s2 s3  r0 g0 b0 d0  r1 g1 b1 d1  r2 g2 b2 d2
    static int place(int i) { return i < 4 ? i : i < 13 ? 4 + (i - 4) / 3 * 4 + (i - 4) % 3 : 4 * (i - 13) + 7; }

    // Writes sin(theta_i) times the cosine and the sine of the azimuth phi, and sin^2(theta_i) times the cosine and the
    // sine of 2 phi. The factors sin(theta_i) and sin^2(theta_i) go to 0 towards normal incidence, which has no
    // azimuth. Returns a pointer to the end of the written numbers.
    static float* azimuth(const Vec3<float>& wi, float* x) {
        const float numbers[] = {wi.x, wi.y, wi.x * wi.x - wi.y * wi.y, 2.0f * wi.x * wi.y};
        return std::copy_n(numbers, 4, x);
    }

    NMA_INLINE void layered3(const float* p, float cosine, float* x) const {
        using Four = Lanes<float>;
        const float sigma_t = p[layered3::SIGMA_T], eta_top = p[layered3::ETA_TOP];
        // The Fresnel reflectance comes first, because it takes the most time.
        // Below the horizon, where nothing is reflected, the reflectance at the horizon is used, because the formula
        // might divide by zero.
        const auto [fresnel, cos_t] = fresnel_dielectric<float>(maximum(cosine, 0.0f), eta_top);
        const Four transmitted = exp(maximum(Four(-sigma_t / maximum(cos_t, MIN_COS_T)), Four(-87.0f)));
        const Four one(1.0f), inside(1.0f / eta_top);
        const Four n = four(p + layered3::ETA_CONDUCTOR) * inside, k = four(p + layered3::K_CONDUCTOR) * inside;
        const Four k2 = k * k, less = n - one, more = n + one;
        Four grazing = fresnel_conductor<Four>(Four(GRAZING), n, k);
        // `normal` is the reflectance at normal incidence, |eta - 1|^2 / |eta + 1|^2, where eta = n + i k is the
        // complex index of refraction.
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

    // Maps four numbers from 0 .. 1 to -1 .. 1, and stores them at `x`.
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
    // These vectors have one lane for each of the four scalar parameters x of `layered3`. y is log(x) where `log_` is
    // 1, and x where `log_` is 0. (y - start_) * per_range_ lies in 0 .. 1.
    Lanes<float> log_{0.0f}, start_{0.0f}, per_range_{0.0f};
};

}  // namespace nma
