// The common part of the BSDFs `nma` and `layered`, which reflect on the front side only. Mitsuba can show, edit and
// evaluate the inputs of these BSDFs.
#pragma once

#include "inputs.h"

namespace mitsuba::nma_plugin {

// Converts a vector of Mitsuba to a vector of the runtime.
template <class Vector>
nma::Vec3<float> direction(const Vector& v) {
    return {v.x(), v.y(), v.z()};
}

// The base class of the BSDFs `nma`, which evaluates an adapter, and `layered`, which simulates the material. Both
// BSDFs read the parameters of the source material, but only `layered` is a source itself.
template <class Float, class Spectrum>
class SourceBSDF : public BSDF<Float, Spectrum> {
public:
    MI_IMPORT_BASE(BSDF, m_flags, m_components)
    MI_IMPORT_TYPES()
    using Inputs = nma_plugin::Inputs<Float, Spectrum>;
    using Input = typename Inputs::Input;

    SourceBSDF(const Properties& props, const std::vector<SourceParam>& parameters, bool trained)
        : Base(props), inputs_(props, parameters, trained) {
        m_flags = inputs_.flags();
        m_components.push_back(m_flags);
    }

    Spectrum eval(const BSDFContext& context, const SurfaceInteraction3f& si, const Vector3f& wo,
                  Mask active) const override {
        return this->eval_pdf(context, si, wo, active).first;
    }

    // Returns the directional albedo of all reflection, not only of the diffuse part, because denoisers call this
    // function for the colour of a surface.
    Spectrum eval_diffuse_reflectance(const SurfaceInteraction3f& si, Mask) const override {
        if (!(si.wi.z() > 0.0f)) return 0.0f;
        const nma::Vec3<float> found = albedo(si);
        return Spectrum(found.x, found.y, found.z);
    }

    void traverse(TraversalCallback* callback) override { inputs_.traverse(callback); }
    void parameters_changed(const std::vector<std::string>&) override { inputs_.changed(); }

    Mask has_attribute(const std::string& name, Mask active) const override {
        return inputs_.find(name) || Base::has_attribute(name, active);
    }

    UnpolarizedSpectrum eval_attribute(const std::string& name, const SurfaceInteraction3f& si,
                                       Mask active) const override {
        const Input* input = inputs_.find(name);
        return input ? UnpolarizedSpectrum(inputs_.at(*input, si)) : Base::eval_attribute(name, si, active);
    }
    // For a colour, returns the mean of its channels, as Mitsuba's own textures do.
    Float eval_attribute_1(const std::string& name, const SurfaceInteraction3f& si, Mask active) const override {
        const Input* input = inputs_.find(name);
        return input ? dr::mean(inputs_.at(*input, si)) : Base::eval_attribute_1(name, si, active);
    }
    Color3f eval_attribute_3(const std::string& name, const SurfaceInteraction3f& si, Mask active) const override {
        const Input* input = inputs_.find(name);
        return input ? inputs_.at(*input, si) : Base::eval_attribute_3(name, si, active);
    }

protected:
    // The directional albedo for the view direction si.wi, whose z is positive.
    virtual nma::Vec3<float> albedo(const SurfaceInteraction3f& si) const = 0;

    // Whether the BSDF reflects nothing, because the surface is seen from behind or the context excludes glossy
    // reflection.
    static bool hidden(const BSDFContext& context, const SurfaceInteraction3f& si) {
        return !(si.wi.z() > 0.0f) || !context.is_enabled(BSDFFlags::GlossyReflection, 0);
    }

    Inputs inputs_;
};

// Registers a plugin for the variant `scalar_rgb` only. Other variants use the Python BSDF of the same name.
#define NMA_EXPORT_SCALAR_PLUGIN(Name)                                                   \
    template class Name<float, Color<float, 3>>;                                         \
    extern "C" MI_EXPORT void init_plugin(std::string_view name, PluginRegisterFn add) { \
        using Plugin = Name<float, Color<float, 3>>;                                     \
        add(name, "scalar_rgb", Plugin::Type,                                            \
            [](void*, const Properties& p) -> ref<Object> { return new Plugin(p); });    \
    }

}  // namespace mitsuba::nma_plugin
