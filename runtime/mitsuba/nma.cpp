// Mitsuba 3 BSDF `nma` for the variant scalar_rgb: a source material, rendered by its adapter. `nma mitsuba build`
// compiles this plugin.
//
// This plugin shares these properties with the Python BSDF of the same name: `adapter` (the name of a shipped adapter,
// or a weights file), `clamp`, and the parameters of the adapter's class. The plugin has two additional properties:
// - `online`: run the network at every shading point. If `online` is false, the blends of an isotropic material without
//   textures are tabulated over cos(theta_i) (`nma::Curves`) when the scene is loaded.
// - `precision`: "float32", "compact" or "bfloat16". "compact" stores weights as bfloat16, which is faster. "bfloat16"
//   also rounds activations to bfloat16 if the CPU has instructions for products of bfloat16.
#include <mitsuba/core/fresolver.h>

#include "nma.h"
#include "source_bsdf.h"

namespace mitsuba::nma_plugin {

template <typename Float, typename Spectrum>
class NmaBSDF final : public SourceBSDF<Float, Spectrum> {
public:
    MI_IMPORT_BASE(SourceBSDF, m_flags, m_components, inputs_, hidden)
    MI_IMPORT_TYPES()
    using typename Base::Inputs;

    explicit NmaBSDF(const Properties& props)
        : NmaBSDF(props, load(adapter_name(props), props.get<std::string_view>("precision", "float32"))) {}

    void parameters_changed(const std::vector<std::string>& keys) override {
        curves_.reset();
        Base::parameters_changed(keys);
        tabulate();
    }

    Float pdf(const BSDFContext& context, const SurfaceInteraction3f& si, const Vector3f& wo,
              Mask active) const override {
        return eval_pdf(context, si, wo, active).second;
    }

    std::pair<Spectrum, Float> eval_pdf(const BSDFContext& context, const SurfaceInteraction3f& si, const Vector3f& wo,
                                        Mask) const override {
        if (hidden(context, si)) return {0.0f, 0.0f};
        return evaluated(context, prepare(si), si, wo);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& context, const SurfaceInteraction3f& si, Float u,
                                             const Point2f& u2, Mask) const override {
        if (hidden(context, si)) return {dr::zeros<BSDFSample3f>(), 0.0f};
        return sampled(context, prepare(si), si, u, u2);
    }

    std::tuple<Spectrum, Float, BSDFSample3f, Spectrum> eval_pdf_sample(const BSDFContext& context,
                                                                        const SurfaceInteraction3f& si,
                                                                        const Vector3f& wo, Float u, const Point2f& u2,
                                                                        Mask) const override {
        if (hidden(context, si)) return {0.0f, 0.0f, dr::zeros<BSDFSample3f>(), 0.0f};
        const nma::Brdf brdf = prepare(si);
        const auto [value, density] = evaluated(context, brdf, si, wo);
        const auto [drawn, weight] = sampled(context, brdf, si, u, u2);
        return {value, density, drawn, weight};
    }

    std::string to_string() const override { return "Nma[\n  adapter = " + name_ + ",\n" + inputs_.to_string() + "]"; }

    MI_DECLARE_CLASS(NmaBSDF)

private:
    static constexpr int MOST_PARAMETERS = 64;

    NmaBSDF(const Properties& props, nma::Adapter adapter)
        : Base(props, wanted(props, adapter), true),
          name_(adapter_name(props)),
          adapter_(std::move(adapter)),
          online_(props.get<bool>("online", false)) {
        if (adapter_.anisotropic()) m_flags = m_components[0] = m_flags | BSDFFlags::Anisotropic;
        tabulate();
    }

    static std::string adapter_name(const Properties& props) {
        return std::string(props.get<std::string_view>("adapter", "layered3-3x32"));
    }

    // The parameters that the BSDF reads are those of the adapter's class. If the adapter was fitted to a single
    // material, the BSDF reads no parameters. For such an adapter, the scene may give the parameters of the single
    // material, but no other values.
    static std::vector<SourceParam> wanted(const Properties& props, const nma::Adapter& adapter) {
        if (adapter.material().empty()) return adapter.parameters();
        const float* known = adapter.material().data();
        for (SourceParam p : adapter.parameters()) {
            if (props.has_property(p.name)) refuse_others(props, p, known);
            known += p.size;
        }
        return {};
    }

    // Throws if the property of parameter `p` differs from `known`, the numbers of `p` in the single material.
    static void refuse_others(const Properties& props, SourceParam p, const float* known) {
        p.low = -1e30, p.high = 1e30;
        const Inputs given(props, {p}, false);
        if (given.textured())
            Throw("the adapter was trained for a single material, so %s cannot be textured; leave %s out", p.name,
                  p.name);
        float numbers[MOST_PARAMETERS];
        given.at(dr::zeros<SurfaceInteraction3f>(), numbers);
        for (int c = 0; c < p.size; ++c)
            if (!nma::same(numbers[c], known[c]))
                Throw(
                    "the adapter was trained for a single material, whose %s is %g, not %g; fit another adapter to "
                    "your material, or use an adapter of its class",
                    p.name, known[c], numbers[c]);
    }

    // Makes the curves for the current inputs if the material is isotropic and has no textures, and `online` is false.
    void tabulate() {
        if (inputs_.textured() || online_ || adapter_.anisotropic()) return;
        float parameters[MOST_PARAMETERS];
        inputs_.at(dr::zeros<SurfaceInteraction3f>(), parameters);
        curves_ = std::make_unique<nma::Curves>(adapter_, parameters);
    }

    // Loads the weights file `name`. Mitsuba's file resolver looks for the file beside the scene, and beside the
    // plugins, where the shipped adapters are.
    static nma::Adapter load(const std::string& name, std::string_view precision) {
        const auto resolver = file_resolver();
        auto path = resolver->resolve(name);
        if (!fs::exists(path)) path = resolver->resolve("adapters/" + name + ".safetensors");
        if (precision != "float32" && precision != "compact" && precision != "bfloat16")
            Throw("precision must be float32, compact or bfloat16, not '%s'", precision);
        nma::Options options;
        options.compact = precision != "float32";
        if (precision == "bfloat16" && nma::supported(nma::InstructionSet::avx512_bf16))
            options.set = nma::InstructionSet::avx512_bf16;
        try {
            nma::Adapter adapter = nma::Adapter::load(fs::exists(path) ? path.string() : name, options);
            if (adapter.parameter_count() > MOST_PARAMETERS)
                throw nma::Error(name + ": the parameters of its class have more than " +
                                 std::to_string(MOST_PARAMETERS) + " numbers");
            return adapter;
        } catch (const nma::Error& e) {
            Throw("%s", e.what());
        }
    }

    nma::Brdf prepare(const SurfaceInteraction3f& si) const {
        const float cosine = nma::clip(static_cast<float>(si.wi.z()), nma::Curves::MIN_COS, 1.0f);
        if (curves_ && inputs_.unchanged(si)) return curves_->at(cosine);
        float parameters[MOST_PARAMETERS];
        inputs_.at(si, parameters);
        return adapter_.prepare(parameters,
                                nma::Direction{static_cast<float>(si.wi.x()), static_cast<float>(si.wi.y()), cosine});
    }

    nma::Vec3<float> albedo(const SurfaceInteraction3f& si) const override {
        return prepare(si).albedo(direction(si.wi));
    }

    std::pair<Spectrum, Float> evaluated(const BSDFContext& context, const nma::Brdf& brdf,
                                         const SurfaceInteraction3f& si, const Vector3f& wo) const {
        const nma::Value v = brdf.eval_pdf(direction(si.wi), direction(wo));
        return {seen(context, si, wo, v.value), v.pdf};
    }

    std::pair<BSDFSample3f, Spectrum> sampled(const BSDFContext& context, const nma::Brdf& brdf,
                                              const SurfaceInteraction3f& si, Float u, const Point2f& u2) const {
        const nma::Sampled s = brdf.sample(direction(si.wi), u, u2.x(), u2.y());
        BSDFSample3f drawn = dr::zeros<BSDFSample3f>();
        if (!(s.pdf > 0.0f)) return {drawn, 0.0f};
        drawn.wo = Vector3f(s.wo.x, s.wo.y, s.wo.z);
        drawn.pdf = s.pdf;
        drawn.eta = 1.0f;
        drawn.sampled_type = +BSDFFlags::GlossyReflection;
        return {drawn, seen(context, si, drawn.wo, s.value) / s.pdf};
    }

    // The value that this plugin returns to Mitsuba. On a path from the camera, the function returns the argument
    // `value`, which was evaluated with the blend for the view direction `si.wi`. On a path from the light, the view
    // direction is `wo`, so the function prepares a blend for `wo`. If the blend depends on the view direction, it is
    // not reciprocal, and the blend for `si.wi` would make paths from the light and paths from the camera disagree. If
    // the blend is constant, the second blend gives the same value, so the function does not test for constant blends.
    Spectrum seen(const BSDFContext& context, const SurfaceInteraction3f& si, const Vector3f& wo,
                  const nma::Vec3<float>& value) const {
        if (context.mode != TransportMode::Importance) return Spectrum(value.x, value.y, value.z);
        if (!(wo.z() > 0.0f)) return 0.0f;
        SurfaceInteraction3f turned = si;
        turned.wi = wo;
        const nma::Vec3<float> back = prepare(turned).eval(direction(wo), direction(si.wi));
        return Spectrum(back.x, back.y, back.z) * (wo.z() / si.wi.z());
    }

    std::string name_;
    nma::Adapter adapter_;
    bool online_;
    std::unique_ptr<nma::Curves> curves_;
};

NMA_EXPORT_SCALAR_PLUGIN(NmaBSDF)

}  // namespace mitsuba::nma_plugin
