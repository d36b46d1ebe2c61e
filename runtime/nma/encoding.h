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
        if (!coated()) return;
        if (parameters_ != layered3::COLUMNS) throw Error(WRONG_CLASS);
        if (kind_ == Kind::Layered3Bounce && !directional_)
            throw Error("the encoding 'layered3_bounce' needs the view direction; train again");
        int k = 0;
        for (const char* name : {"alpha_top", "alpha_bottom", "eta_top", "sigma_t"}) {
            const SourceParam& p = scalar(weights, name);
            log_.set(k, p.logarithmic);
            start_.set(k, p.start);
            per_range_.set(k++, p.per_range);
        }
        if (kind_ == Kind::Layered3Bounce && log_[2] != 0.0f) throw Error(WRONG_CLASS);
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

    // Reorders the inputs of the network in a layer of a file that reads them, to the order in which `encode` writes
    // them. The orders differ only for coated materials: see `places`.
    Layer arranged(const Layer& layer) const {
        if (!coated()) return layer;
        const int neurons = layer.in - layer.skipped, in = neurons + 4 * LANES;
        Layer made{in, layer.out, std::vector<float>(in * static_cast<std::size_t>(layer.out)), layer.bias, 4 * LANES};
        for (int j = 0; j < layer.out; ++j)
            for (int i = 0; i < layer.in; ++i) {
                const int to = i < neurons ? i : neurons + places()[i - neurons];
                made.matrix[j * in + to] = layer.matrix[j * layer.in + i];
            }
        return made;
    }

    // Writes the inputs for the parameters `p` to `x`, and fills `x` with zeros up to `stride` numbers.
    void encode(const float* p, const Vec3<float>& wi, float* x, int stride) const {
        if (kind_ == Kind::Layered3) return layered3(p, wi.z, x);
        if (kind_ == Kind::Layered3Bounce) return layered3_bounce(p, wi.z, x);
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
    using Four = Lanes<float>;
    enum class Kind { Raw, Direction, Azimuth, Layered3, Layered3Bounce };
    static constexpr const char* WRONG_CLASS = "the encoding does not fit the parameters of its class; train again";

    static Kind kind_named(const std::string& name) {
        if (name == "raw") return Kind::Raw;
        if (name == "direction") return Kind::Direction;
        if (name == "azimuth") return Kind::Azimuth;
        if (name == "layered3") return Kind::Layered3;
        if (name == "layered3_bounce") return Kind::Layered3Bounce;
        throw Error("unknown input encoding '" + shown(name) + "'; upgrade the runtime");
    }

    // The parameter called `name`. Throws unless this parameter exists and has one number.
    static const SourceParam& scalar(const Weights& weights, const char* name) {
        for (const SourceParam& p : weights.parameters)
            if (p.name == name && p.size == 1) return p;
        throw Error(WRONG_CLASS);
    }

    // Whether the inputs describe a coated conductor: those of `layered3` and of `layered3_bounce`.
    bool coated() const { return kind_ == Kind::Layered3 || kind_ == Kind::Layered3Bounce; }

    // The position to which `encode` writes each input of a coated material. `encode` computes vectors of four lanes:
    // four scalars s, and then three vectors, in which it appends one of the numbers d that depend on the direction to
    // each colour (r, g, b). The last vector of `layered3_bounce` holds four estimates e.
    //
    //     `layered3` in training           s0 s1 s2 s3  r0 g0 b0  r1 g1 b1  r2 g2 b2  d0 d1 d2
    //     `layered3` in `encode`           s0 s1 s2 s3  r0 g0 b0 d0  r1 g1 b1 d1  r2 g2 b2 d2
    //     `layered3_bounce` in training    s0 s1 s2 s3  r0 g0 b0  r1 g1 b1  d0 d1  e0 e1 e2 e3
    //     `layered3_bounce` in `encode`    s0 s1 s2 s3  r0 g0 b0 d0  r1 g1 b1 d1  e0 e1 e2 e3
    const int* places() const {
        static constexpr int LAYERED3[] = {0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 12, 13, 14, 7, 11, 15};
        static constexpr int LAYERED3_BOUNCE[] = {0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 12, 13, 14, 15};
        return kind_ == Kind::Layered3 ? LAYERED3 : LAYERED3_BOUNCE;
    }

    // Writes sin(theta_i) times the cosine and the sine of the azimuth phi, and sin^2(theta_i) times the cosine and the
    // sine of 2 phi. The factors sin(theta_i) and sin^2(theta_i) go to 0 towards normal incidence, which has no
    // azimuth. Returns a pointer to the end of the written numbers.
    static float* azimuth(const Vec3<float>& wi, float* x) {
        const float numbers[] = {wi.x, wi.y, wi.x * wi.x - wi.y * wi.y, 2.0f * wi.x * wi.y};
        return std::copy_n(numbers, 4, x);
    }

    // The light at the coat, and the conductor under it.
    struct Coated {
        float inside;          // 1 / eta_top
        float fresnel, cos_t;  // the reflectance of the coat, and the cosine of the refracted view
        float sigma_t, depth;  // optical depths of the medium: along the normal, and along the refracted view
        Four n, k;             // the conductor's index of refraction n + i k, relative to the coat

        // Below the horizon, where nothing is reflected, the reflectance at the horizon is used, because the formula
        // might divide by zero.
        NMA_INLINE Coated(const float* p, float cosine)
            : inside(1.0f / p[layered3::ETA_TOP]), sigma_t(maximum(p[layered3::SIGMA_T], 0.0f)) {
            std::tie(fresnel, cos_t) = fresnel_dielectric<float>(maximum(cosine, 0.0f), p[layered3::ETA_TOP]);
            depth = sigma_t / maximum(cos_t, MIN_COS_T);
            n = four(p + layered3::ETA_CONDUCTOR) * Four(inside);
            k = four(p + layered3::K_CONDUCTOR) * Four(inside);
        }

        // The reflectance of the conductor at normal incidence, |eta - 1|^2 / |eta + 1|^2, where eta = n + i k.
        NMA_INLINE Four normal() const {
            const Four one(1.0f), k2 = k * k, less = n - one, more = n + one;
            return (less * less + k2) / (more * more + k2);
        }
        // The reflectance of the conductor at the refracted view, as numerator and denominator. The formula is that of
        // `fresnel_conductor`. In the logit of the estimate, the denominator needs no division of its own.
        NMA_INLINE std::pair<Four, Four> reflectance() const {
            const Four cos(cos_t), cos2 = cos * cos, sin2 = Four(1.0f) - cos2, n2 = n * n, k2 = k * k;
            const Four t0 = n2 - k2 - sin2, a2b2 = sqrt(t0 * t0 + Four(4.0f) * n2 * k2);
            const Four t1 = a2b2 + cos2, t2 = Four(2.0f) * cos * safe_sqrt(Four(0.5f) * (a2b2 + t0));
            const Four t3 = cos2 * a2b2 + sin2 * sin2 + Four(1e-30f), t4 = t2 * sin2;
            // (r_s + r_p) / 2, where r_p is r_s (t3 - t4) / (t3 + t4), is r_s t3 / (t3 + t4).
            return {(t1 - t2) * t3, (t1 + t2) * (t3 + t4)};
        }
    };

    static NMA_INLINE Four scalars(const float* p) {
        return {p[layered3::ALPHA_TOP], p[layered3::ALPHA_BOTTOM], p[layered3::ETA_TOP], p[layered3::SIGMA_T]};
    }
    // Stores the four scalars. `logs` holds their logarithms, in those lanes where `log_` is 1.
    NMA_INLINE void put_scalars(const Four& scalars, const Four& logs, float* x) const {
        put(x, (scalars + (logs - scalars) * log_ - start_) * per_range_);
    }
    static NMA_INLINE Four logarithms(const Four& x) { return log(maximum(x, Four(1e-30f))); }

    NMA_INLINE void layered3(const float* p, float cosine, float* x) const {
        const Coated coated(p, cosine);
        Four normal = coated.normal(), grazing = fresnel_conductor<Four>(Four(GRAZING), coated.n, coated.k);
        Four albedo = four(p + layered3::ALBEDO);
        normal.set(3, directional_ ? cosine : 0.0f);
        grazing.set(3, directional_ ? coated.fresnel : 0.0f);
        albedo.set(3, directional_ ? exp(maximum(Four(-coated.depth), Four(-87.0f)))[0] : 0.0f);
        put_scalars(scalars(p), logarithms(scalars(p)), x);
        put(x + LANES, normal);
        put(x + 2 * LANES, grazing);
        put(x + 3 * LANES, albedo);
    }

    NMA_INLINE void layered3_bounce(const float* p, float cosine, float* x) const {
        const Coated coated(p, cosine);
        // The logarithms of the two widths, and of the square of the width of the estimated lobe. The square is in the
        // lane of the index, which has no logarithm.
        Four widths = scalars(p);
        const float bend = 0.5f * (1.0f - coated.inside) * widths[0];
        widths.set(2, widths[1] * widths[1] + 2.0f * bend * bend);
        const Four logs = logarithms(widths);
        Four normal = coated.normal(), albedo = four(p + layered3::ALBEDO);
        normal.set(3, maximum(cosine, 0.0f));
        albedo.set(3, coated.fresnel);
        put_scalars(scalars(p), logs, x);
        put(x + LANES, normal);
        put(x + 2 * LANES, albedo);
        const Four logit = estimates(coated, 1.0f - logs[2] * per_log_alpha2_);
        std::memcpy(x + 3 * LANES, &logit, sizeof(logit));
    }

    // The logits of the estimates of base_color and roughness, in the unit ESTIMATE_UNIT. The logit of e is -log(1 / e
    // - 1).
    static NMA_INLINE Four estimates(const Coated& coated, float roughness) {
        auto [part, whole] = coated.reflectance();
        part = part * Four(1.0f - coated.fresnel);
        part.set(3, roughness);
        whole.set(3, 1.0f);
        // The light crosses the medium along the view, and then upwards. The limit keeps the power finite.
        Four depth(minimum(coated.depth + coated.sigma_t, 60.0f));
        depth.set(3, 0.0f);
        const Four odds = whole / maximum(part, Four(1e-30f)) * exp(depth) - Four(1.0f);
        constexpr float MOST_ODDS = (1.0f - LEAST_ESTIMATE) / LEAST_ESTIMATE;
        const Four clipped = clip(odds, Four(1.0f / MOST_ODDS), Four(MOST_ODDS));
        return log(clipped) * Four(-1.0f / ESTIMATE_UNIT);
    }

    // Maps four numbers from 0 .. 1 to -1 .. 1, and stores them at `x`.
    static void put(float* x, const Four& units) {
        const Four spread = units * Four(2.0f) - Four(1.0f);
        std::memcpy(x, &spread, sizeof(spread));
    }

    static Four four(const float* p) {
        Four found;
        std::memcpy(&found, p, sizeof(found));
        return found;
    }

    Kind kind_ = Kind::Raw;
    bool directional_ = false;
    int parameters_ = 0;
    // These vectors have one lane for each of the four scalar parameters x of `layered3`. y is log(x) where `log_` is
    // 1, and x where `log_` is 0. (y - start_) * per_range_ lies in 0 .. 1.
    Four log_{0.0f}, start_{0.0f}, per_range_{0.0f};
    // The logarithm of a squared width times `per_log_alpha2_` is 1 for the width MIN_ALPHA, and 0 for the width 1.
    float per_log_alpha2_ = 0.5f / std::log(MIN_ALPHA<float>);
};

}  // namespace nma
