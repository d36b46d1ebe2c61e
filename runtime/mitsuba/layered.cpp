// Mitsuba 3 BSDF `layered` for the variant scalar_rgb: the simulated material itself, which is the reference for its
// adapter. `nma mitsuba build` compiles this plugin. The properties of the BSDF are the parameters of the class
// `layered3`.
//
// `eval` returns one unbiased estimate of the value. Mitsuba passes no random numbers to `eval`, so `eval` derives
// random numbers from the bits of its arguments.
//
// `sample` simulates one walk if this BSDF is the BSDF of the shape. Other BSDFs, such as `blendbsdf` and `mask`, may
// contain this BSDF. `blendbsdf` and `mask` compute weights from the densities of samples, so the sampled directions
// must have exactly the density `pdf`. The directions of walks have another density, so inside of other BSDFs `sample`
// draws directions with the density `pdf` instead of simulating a walk. The weight of a direction drawn with the
// density `pdf` is an estimate of the value, divided by `pdf`.
#include <mitsuba/core/random.h>
#include <mitsuba/render/shape.h>

#include "nma/generated/classes.h"
#include "nma/layered.h"
#include "source_bsdf.h"

namespace mitsuba::nma_plugin {

template <typename Float, typename Spectrum>
class LayeredBSDF final : public SourceBSDF<Float, Spectrum> {
public:
    MI_IMPORT_BASE(SourceBSDF, inputs_, hidden)
    MI_IMPORT_TYPES(Shape)
    using typename Base::Inputs;

    explicit LayeredBSDF(const Properties& props) : Base(props, nma::layered3_parameters(), false) {}

    Float pdf(const BSDFContext& context, const SurfaceInteraction3f& si, const Vector3f& wo, Mask) const override {
        return hidden(context, si) ? 0.0f : View(inputs_, si).pdf(wo);
    }

    std::pair<Spectrum, Float> eval_pdf(const BSDFContext& context, const SurfaceInteraction3f& si, const Vector3f& wo,
                                        Mask) const override {
        if (hidden(context, si)) return {0.0f, 0.0f};
        return evaluated(View(inputs_, si), si, wo);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& context, const SurfaceInteraction3f& si, Float u,
                                             const Point2f& u2, Mask) const override {
        if (hidden(context, si)) return {dr::zeros<BSDFSample3f>(), 0.0f};
        return sampled(View(inputs_, si), si, u, u2);
    }

    std::tuple<Spectrum, Float, BSDFSample3f, Spectrum> eval_pdf_sample(const BSDFContext& context,
                                                                        const SurfaceInteraction3f& si,
                                                                        const Vector3f& wo, Float u, const Point2f& u2,
                                                                        Mask) const override {
        if (hidden(context, si)) return {0.0f, 0.0f, dr::zeros<BSDFSample3f>(), 0.0f};
        const View view(inputs_, si);
        const auto [value, pdf] = evaluated(view, si, wo);
        const auto [drawn, weight] = sampled(view, si, u, u2);
        return {value, pdf, drawn, weight};
    }

    std::string to_string() const override { return "Layered[\n" + inputs_.to_string() + "]"; }

    MI_DECLARE_CLASS(LayeredBSDF)

private:
    // The material at one shading point, and the view direction.
    struct View {
        nma::layered::Stack stack;
        nma::layered::Vec wi;
        nma::layered::Density density;

        View(const Inputs& inputs, const SurfaceInteraction3f& si)
            : stack(at(inputs, si)), wi(direction(si.wi)), density(stack, wi) {}

        float pdf(const Vector3f& wo) const { return nma::layered::pdf(stack, density, wi, direction(wo)); }
    };

    static nma::layered::Stack at(const Inputs& inputs, const SurfaceInteraction3f& si) {
        float numbers[nma::layered3::COLUMNS];
        inputs.at(si, numbers);
        return nma::layered::Stack::of(numbers);
    }

    nma::Vec3<float> albedo(const SurfaceInteraction3f& si) const override {
        return nma::layered::albedo(at(inputs_, si), direction(si.wi));
    }

    // A random number generator that is seeded with the bits of `numbers`.
    template <std::size_t N>
    static nma::layered::Random random(const float (&numbers)[N]) {
        std::uint32_t a = N, b = 0x9e3779b9u;
        for (std::size_t k = 0; k < N; ++k) {
            (k % 2 ? b : a) ^= nma::bits(numbers[k]);
            if (k % 2 || k + 1 == N) std::tie(a, b) = sample_tea_32(a, b);
        }
        return nma::layered::Random(static_cast<std::uint64_t>(a) << 32 | b, b);
    }

    static std::pair<Spectrum, Float> evaluated(const View& view, const SurfaceInteraction3f& si, const Vector3f& wo) {
        if (!(wo.z() > 0.0f)) return {0.0f, 0.0f};
        nma::layered::Random rng = random({wo.x(), wo.y(), wo.z(), si.wi.x(), si.wi.y(), si.wi.z(), si.p.x(), si.p.y(),
                                           si.p.z(), si.uv.x(), si.uv.y()});
        const nma::Vec3<float> value = nma::layered::evaluate(view.stack, view.wi, direction(wo), rng);
        return {Spectrum(value.x, value.y, value.z), view.pdf(wo)};
    }

    std::pair<BSDFSample3f, Spectrum> sampled(const View& view, const SurfaceInteraction3f& si, Float u,
                                              const Point2f& u2) const {
        BSDFSample3f drawn = dr::zeros<BSDFSample3f>();
        drawn.eta = 1.0f;
        drawn.sampled_type = +BSDFFlags::GlossyReflection;
        const bool alone = si.shape && si.shape->bsdf() == this;
        const Spectrum weight = alone ? walked(view, si, u, u2, drawn) : followed(view, si, u, u2, drawn);
        if (!(drawn.pdf > 0.0f)) return {dr::zeros<BSDFSample3f>(), 0.0f};
        return {drawn, weight};
    }

    // Simulates a walk, writes the walk's final direction to `drawn`, and returns the walk's throughput.
    // `drawn.pdf` is close to the unknown density of the walk's direction.
    static Spectrum walked(const View& view, const SurfaceInteraction3f& si, Float u, const Point2f& u2,
                           BSDFSample3f& drawn) {
        nma::layered::Random rng = random({u, u2.x(), u2.y(), si.wi.x(), si.wi.y(), si.wi.z()});
        const nma::layered::Walk walk = nma::layered::walk(view.stack, view.wi, rng);
        const nma::Vec3<float>& t = walk.throughput;
        drawn.wo = Vector3f(walk.direction.x, walk.direction.y, walk.direction.z);
        if (t.x > 0.0f || t.y > 0.0f || t.z > 0.0f) drawn.pdf = view.pdf(drawn.wo);
        return Spectrum(t.x, t.y, t.z);
    }

    // Draws a direction with the exact density `pdf`, and writes it to `drawn`. Returns an estimate of the value,
    // divided by the density.
    static Spectrum followed(const View& view, const SurfaceInteraction3f& si, Float u, const Point2f& u2,
                             BSDFSample3f& drawn) {
        const nma::Vec3<float> wo = nma::layered::sample(view.stack, view.density, view.wi, u, u2.x(), u2.y()).wo;
        drawn.wo = Vector3f(wo.x, wo.y, wo.z);
        const auto [value, pdf] = evaluated(view, si, drawn.wo);
        drawn.pdf = pdf;
        return value / pdf;
    }
};

NMA_EXPORT_SCALAR_PLUGIN(LayeredBSDF)

}  // namespace mitsuba::nma_plugin
