// The BRDF for a view direction: a blend in the frame in which it holds. Twin of nma/target/brdf.py.
#pragma once

#include "blend.h"

namespace nma {

using Direction = Vec3<float>;
using Value = Evaluation<float>;
using Sampled = Sample<float>;

// The BRDF at one shading point. It holds for the cos(theta_i) that it was prepared for. If the adapter is anisotropic,
// it holds for that `wi` only.
class Brdf {
public:
    // The value f cos(theta_o) [1/sr], 0 below the horizon.
    Vec3<float> eval(const Direction& wi, const Direction& wo) const { return eval_pdf(wi, wo).value; }

    // The density of `sample` [1/sr], 0 below the horizon.
    float pdf(const Direction& wi, const Direction& wo) const { return eval_pdf(wi, wo).pdf; }

    // The value and the density together. This takes no longer than one of them.
    Value eval_pdf(const Direction& wi, const Direction& wo) const {
        const Plane<float> plane = frame(wi);
        return nma::eval_pdf(blend_, plane_enter<float>(plane, wi), plane_enter<float>(plane, wo));
    }

    // A direction from three uniform numbers in [0, 1), with its value and its density. A density of 0 marks an invalid
    // direction.
    Sampled sample(const Direction& wi, float u_lobe, float u1, float u2) const {
        const Plane<float> plane = frame(wi);
        Sampled found = nma::sample(blend_, plane_enter<float>(plane, wi), u_lobe, u1, u2);
        found.wo = plane_leave<float>(plane, found.wo);
        return found;
    }

    // The directional albedo at `wi`, at most 1, as RGB. Denoisers ask for it. It is the mean of value / pdf over
    // samples at fixed points (Roberts 2018, "R2").
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

    // The frame in which the blend holds. Lobes that were trained in the plane of incidence stretch along that plane.
    // Each call finds the plane again, because a BRDF that was prepared for a cosine serves all azimuths.
    Plane<float> frame(const Direction& wi) const { return in_plane_ ? plane_of<float>(wi) : Plane<float>{1.0f, 0.0f}; }

    Blend<float> blend_;
    bool in_plane_ = false;
};

// The former name of `Brdf`.
using Material = Brdf;

}  // namespace nma
