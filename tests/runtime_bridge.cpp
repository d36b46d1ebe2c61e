// These functions extend the C interface for the tests of the runtime. The functions evaluate the target on arrays, in
// float and in double, and copy the parameters of a BRDF's blend to an array.
#include "nma.h"
#include "nma_c.h"

namespace {

constexpr int PRINCIPLED_SIZE = nma::Blend<float>::PRINCIPLED_SIZE;

// Makes a blend of `Principled` instances from an array. The array holds the fields of the first instance in the order
// of `Principled`, the fields of the second instance, and so on, and then the weights of all instances.
template <class T>
nma::Blend<T> blend_of(const T* numbers, int count) {
    nma::Blend<T> made(count);
    for (int k = 0; k < count; ++k) {
        nma::Principled<T> instance;
        std::memcpy(&instance, numbers + PRINCIPLED_SIZE * k, sizeof(instance));
        made.set(k, instance, numbers[PRINCIPLED_SIZE * count + k]);
    }
    return made;
}

template <class T>
void evaluate(int n, int count, bool bounded, const T* blends, const T* wi, const T* wo, T* out) {
    for (int i = 0; i < n; ++i, blends += (PRINCIPLED_SIZE + 1) * count, wi += 3, wo += 3, out += 4) {
        nma::Blend<T> blend = blend_of(blends, count);
        nma::set_lobe_probabilities(blend, wi[2], bounded);
        const auto e = nma::eval_pdf<T>(blend, {wi[0], wi[1], wi[2]}, {wo[0], wo[1], wo[2]});
        const T row[] = {e.value.x, e.value.y, e.value.z, e.pdf};
        std::copy_n(row, 4, out);
    }
}

}  // namespace

extern "C" {

void evaluate_float(int n, int count, bool bounded, const float* blends, const float* wi, const float* wo, float* out) {
    evaluate(n, count, bounded, blends, wi, wo, out);
}

void evaluate_double(int n, int count, bool bounded, const double* blends, const double* wi, const double* wo,
                     double* out) {
    evaluate(n, count, bounded, blends, wi, wo, out);
}

// Writes rows of seven numbers: wo, value and pdf.
void sample_double(int n, int count, const double* blends, const double* wi, const double* u, double* out) {
    for (int i = 0; i < n; ++i, blends += (PRINCIPLED_SIZE + 1) * count, wi += 3, u += 3, out += 7) {
        nma::Blend<double> blend = blend_of(blends, count);
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
