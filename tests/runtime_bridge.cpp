// These functions extend the C interface for the tests of the runtime. The functions evaluate the target on arrays, in
// float and in double, and copy the parameters of a BRDF's blend to an array.
#include "nma.h"
#include "nma_c.h"

namespace {

constexpr int PRINCIPLED_SIZE = nma::Blend<float>::PRINCIPLED_SIZE;

// Makes a blend of `Principled` instances from an array. The array holds the fields of the first instance in the order
// of `Principled`, the fields of the second instance, and so on, and then the weights of all instances. `interface`
// holds the width and the index of the interface above the blend, or is null.
template <class T>
nma::Blend<T> blend_of(const T* numbers, int count, const T* interface) {
    nma::Blend<T> made(count);
    made.under_interface = interface != nullptr;
    if (interface) made.interface = {interface[0], interface[1]};
    for (int k = 0; k < count; ++k) {
        nma::Principled<T> instance;
        std::memcpy(&instance, numbers + PRINCIPLED_SIZE * k, sizeof(instance));
        made.set(k, instance, numbers[PRINCIPLED_SIZE * count + k]);
    }
    return made;
}

// The interface with the index i, or null if there are no interfaces.
template <class T>
const T* interface_of(const T* interfaces, int i) {
    return interfaces ? interfaces + 2 * i : nullptr;
}

template <class T>
void evaluate(int n, int count, bool bounded, const T* blends, const T* interfaces, const T* wi, const T* wo, T* out) {
    for (int i = 0; i < n; ++i, blends += (PRINCIPLED_SIZE + 1) * count, wi += 3, wo += 3, out += 4) {
        nma::Blend<T> blend = blend_of(blends, count, interface_of(interfaces, i));
        nma::set_lobe_probabilities(blend, wi[2], bounded);
        const auto e = nma::eval_pdf<T>(blend, {wi[0], wi[1], wi[2]}, {wo[0], wo[1], wo[2]});
        const T row[] = {e.value.x, e.value.y, e.value.z, e.pdf};
        std::copy_n(row, 4, out);
    }
}

}  // namespace

extern "C" {

void evaluate_float(int n, int count, bool bounded, const float* blends, const float* interfaces, const float* wi,
                    const float* wo, float* out) {
    evaluate(n, count, bounded, blends, interfaces, wi, wo, out);
}

void evaluate_double(int n, int count, bool bounded, const double* blends, const double* interfaces, const double* wi,
                     const double* wo, double* out) {
    evaluate(n, count, bounded, blends, interfaces, wi, wo, out);
}

// Writes rows of seven numbers: wo, value and pdf.
void sample_double(int n, int count, const double* blends, const double* interfaces, const double* wi, const double* u,
                   double* out) {
    for (int i = 0; i < n; ++i, blends += (PRINCIPLED_SIZE + 1) * count, wi += 3, u += 3, out += 7) {
        nma::Blend<double> blend = blend_of(blends, count, interface_of(interfaces, i));
        nma::set_lobe_probabilities(blend, wi[2], false);
        const auto s = nma::sample<double>(blend, {wi[0], wi[1], wi[2]}, u[0], u[1], u[2]);
        const double row[] = {s.wo.x, s.wo.y, s.wo.z, s.value.x, s.value.y, s.value.z, s.pdf};
        std::copy_n(row, 7, out);
    }
}

// Writes the blends of n BRDFs that the C interface made: the fields of all instances, and then their weights.
void brdf_numbers(int n, int count, const nma_brdf* brdfs, float* out) {
    for (int i = 0; i < n; ++i, out += (PRINCIPLED_SIZE + 1) * count) {
        const nma::Blend<float>& blend = reinterpret_cast<const nma::Brdf*>(brdfs + i)->blend();
        for (int k = 0; k < count; ++k) {
            const nma::Principled<float> instance = blend.instance(k);
            std::memcpy(out + PRINCIPLED_SIZE * k, &instance, sizeof(instance));
            out[PRINCIPLED_SIZE * count + k] = blend.weight(k);
        }
    }
}

// Writes the width and the index of the interface of n BRDFs, or zeros for BRDFs without an interface.
void brdf_interfaces(int n, const nma_brdf* brdfs, float* out) {
    for (int i = 0; i < n; ++i, out += 2) {
        const nma::Blend<float>& blend = reinterpret_cast<const nma::Brdf*>(brdfs + i)->blend();
        out[0] = blend.under_interface ? blend.interface.alpha : 0.0f;
        out[1] = blend.under_interface ? blend.interface.eta : 0.0f;
    }
}

// Writes the scales of n BRDFs as RGB.
void brdf_scales(int n, const nma_brdf* brdfs, float* out) {
    for (int i = 0; i < n; ++i, out += 3) {
        const nma::Vec3<float>& scale = reinterpret_cast<const nma::Brdf*>(brdfs + i)->blend().scale;
        const float row[] = {scale.x, scale.y, scale.z};
        std::copy_n(row, 3, out);
    }
}

int brdf_size() { return sizeof(nma::Brdf); }
int curve_nodes() { return nma::Curves::NODES; }
float curve_min_cos() { return nma::Curves::MIN_COS; }
}
