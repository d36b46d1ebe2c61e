// Neural Material Adapter: renders expensive materials as blends of Principled BRDFs, whose parameters a tiny network
// computes.
//
//     const nma::Adapter adapter = nma::Adapter::load("layered3-3x32.safetensors");
//     adapter.clamp(parameters);                                         // or refuse them: adapter.check(parameters)
//     const nma::Brdf brdf = adapter.prepare(parameters, wi);            // once per shading point
//     const nma::Value v = brdf.eval_pdf(wi, wo);                        // f cos(theta_o) [1/sr] and pdf [1/sr]
//     const nma::Sampled s = brdf.sample(wi, u_lobe, u1, u2);
//
// The headers are C++17 and have no dependencies. The network uses the widest vector instructions of the CPU
// (`InstructionSet`). Loading an adapter and making `Curves` allocate memory and may throw `nma::Error`. No other
// function allocates memory or throws, and many threads may call the other functions at once. Directions are unit
// vectors in the local frame, with z up. `wi` points towards the viewer, and `wo` towards the light.
//
// The headers, in the order in which a query uses them:
//
//     nma.h              Adapter, Curves, and the functions ..._many
//     nma/weights.h      Weights: the weights file, read and checked; nma/json.h reads its JSON
//     nma/encoding.h     Encoding: from parameters and `wi` to the inputs of the network
//     nma/network.h      Network: the weights in the order in which kernels read them; nma/kernels/layout.h shows it
//     nma/kernels.h      Kernels: the functions of each instruction set; their code is in nma/kernels/
//     nma/preparation.h  Preparation: all that these functions read; `assemble`, which fills in a blend
//     nma/brdf.h         Brdf: a blend and its frame, what `prepare` returns
//     nma/blend.h        Blend: value, density and sample of all lobes; nma/lanes.h computes four instances at once
//     nma/generated/     printed from Python; never edit it
//       target.h         Principled: one instance; Plane: the plane of incidence
//       classes.h        the parameters of each class
//       constants.h      constants shared with Python
//     nma/layered.h      the simulated layered material, which no adapter needs
//     nma/error.h        Error
#pragma once

#include <cstddef>

#include "nma/brdf.h"
#include "nma/network.h"
#include "nma/weights.h"

namespace nma {

// The options for loading a weights file.
struct Options {
    // If the CPU lacks the instruction set, `portable` is used instead. All instruction sets compute in float32, except
    // avx512_bf16. avx512_bf16 rounds weights and activations to bfloat16, which keeps 8 significant bits, and so
    // halves the time of a network on some CPUs.
    InstructionSet set = fastest();
    // Rounds weights to bfloat16, which halves the memory that a query has to read. The rounding raised the log loss
    // (runtime/README.md) of both shipped adapters by less than .00002. The instruction set avx512_bf16 always rounds
    // weights.
    bool compact = false;
};

class Adapter {
public:
    // `prepare_many` splits the queries into blocks of at most BLOCK queries.
    static constexpr int BLOCK = 24;

    static Adapter load(const std::string& path, const Options& options = {}) {
        try {
            const std::string bytes = read_file(path);
            return from_memory(bytes.data(), bytes.size(), options);
        } catch (const Error& e) {
            throw Error(path + ": " + e.what());
        }
    }

    static Adapter from_memory(const void* bytes, std::size_t size, const Options& options = {}) {
        return Adapter(parse_weights(bytes, size), options);
    }

    // The count of numbers that `prepare` reads as the parameters of a material. The numbers are in the order of
    // `parameters()`. A colour has three numbers.
    int parameter_count() const { return preparation_.encoding.parameters(); }
    const std::vector<SourceParam>& parameters() const { return weights_.parameters; }
    // The parameters of the single material that the adapter was fitted to, for which `prepare` reads no parameters.
    // The vector is empty if the adapter was trained on a class.
    const std::vector<float>& material() const { return weights_.material; }
    // The index of the first number that is not allowed, or -1 if all numbers are allowed. A number is allowed if it is
    // finite and lies in its training range. Outside the training range, the BRDF looks plausible, but does not match
    // the source material. If the adapter was fitted to a single material, only the parameters of that material are
    // allowed. `parameter(index)` returns the parameter to which the number at `index` belongs.
    int check(const float* parameters) const {
        for (int k = 0; k < parameter_count(); ++k)
            if (!allowed(k, parameters[k])) return k;
        return -1;
    }
    // Moves each number into its training range, and NaN to the lower end of the range. Does nothing if the adapter was
    // fitted to a single material.
    void clamp(float* parameters) const {
        if (!material().empty()) return;
        for (int k = 0; k < parameter_count(); ++k) parameters[k] = parameter(k).clamped(parameters[k]);
    }
    // The parameter to which the number at `index` of the array `parameters` belongs.
    const SourceParam& parameter(int index) const { return weights_.parameters[owners_[index]]; }

    // The count of numbers that the network returns for a query. The numbers returned by the network describe a blend.
    int output_count() const { return preparation_.outputs; }
    InstructionSet instruction_set() const { return network_.instruction_set(); }

    // Whether the BRDF depends on the azimuth of `wi`. If the azimuth does not matter, `prepare` reads only wi.z.
    // Functions that take a cosine c instead of `wi` use the azimuth 0, which is wi = (sqrt(1 - c^2), 0, c).
    bool anisotropic() const { return preparation_.encoding.anisotropic(); }

    // The BRDF of the source material with the parameters `parameters`, for the view direction `wi`. wi.z is in (0, 1].
    Brdf prepare(const float* parameters, const Direction& wi) const {
        Brdf made;
        made.in_plane_ = in_plane_;
        kernels().prepare(preparation_, parameters, wi, made.blend_);
        return made;
    }
    Brdf prepare(const float* parameters, float cos_theta_i) const {
        return prepare(parameters, at_azimuth_0(cos_theta_i));
    }

    // Prepares the BRDFs of many shading points, and reads the weights from memory once for several shading points.
    // `parameters` has a row of `parameter_count` numbers for each shading point.
    void prepare_many(int count, const float* parameters, const Direction* wi, Brdf* brdfs) const {
        alignas(64) float outputs[BLOCK * WIDEST_LAYER];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            outputs_of_block(now, row(parameters, first), wi + first, outputs);
            for (int q = 0; q < now; ++q) {
                Brdf& made = brdfs[first + q];
                made.in_plane_ = in_plane_;
                kernels().decode(preparation_, row(parameters, first + q), outputs + q * network_.output_stride(),
                                 wi[first + q].z, made.blend_);
            }
            for (int q = first; q < first + now; ++q)
                kernels().set_lobe_probabilities(preparation_, wi[q].z, brdfs[q].blend_);
        }
    }
    void prepare_many(int count, const float* parameters, const float* cos_theta_i, Brdf* brdfs) const {
        in_blocks(count, cos_theta_i, [&](int first, int now, const Direction* wi) {
            prepare_many(now, row(parameters, first), wi, brdfs + first);
        });
    }

    // The outputs of the network before decoding. `raw` must be aligned to 64 bytes and have room for WIDEST_LAYER
    // numbers.
    void network_outputs(const float* parameters, const Direction& wi, float* raw) const {
        alignas(64) float inputs[WIDEST_LAYER];
        kernels().encode(preparation_, parameters, wi, inputs);
        network_.forward(inputs, raw);
    }
    void network_outputs(const float* parameters, float cos_theta_i, float* raw) const {
        network_outputs(parameters, at_azimuth_0(cos_theta_i), raw);
    }

    // The outputs of the network for many queries. `raw` gets a row of `output_count` numbers for each query, and need
    // not be aligned.
    void network_outputs_many(int count, const float* parameters, const Direction* wi, float* raw) const {
        alignas(64) float outputs[BLOCK * WIDEST_LAYER];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            outputs_of_block(now, row(parameters, first), wi + first, outputs);
            for (int q = 0; q < now; ++q)
                std::copy_n(outputs + q * network_.output_stride(), output_count(),
                            raw + static_cast<std::size_t>(first + q) * output_count());
        }
    }
    void network_outputs_many(int count, const float* parameters, const float* cos_theta_i, float* raw) const {
        in_blocks(count, cos_theta_i, [&](int first, int now, const Direction* wi) {
            network_outputs_many(now, row(parameters, first), wi,
                                 raw + static_cast<std::size_t>(first) * output_count());
        });
    }

private:
    friend class Curves;

    // The order of the steps matters, because each step reads results of the steps before it.
    Adapter(Weights weights, const Options& options) : weights_(std::move(weights)) {
        // Computes the counts of inputs and outputs from the description in the file.
        for (const TargetParam& p : weights_.target) add_places(p);
        for (std::size_t k = 0; k < weights_.parameters.size(); ++k)
            owners_.insert(owners_.end(), weights_.parameters[k].size, k);
        preparation_.encoding = Encoding(weights_);
        preparation_.instances = weights_.instances;
        preparation_.outputs = static_cast<int>(places_.size()) * weights_.instances + weights_.instances - 1;
        preparation_.bounded = weights_.bounded;
        preparation_.interface = weights_.interface.empty() ? nullptr : weights_.interface.data();
        preparation_.material = material().empty() ? nullptr : material().data();
        // `check_description` compares the counts of inputs and outputs with the sizes of the layers, so it must
        // precede the changes to the layers below.
        check_description();
        // Reorders the inputs of the network to the order in which `encode` writes them, in all layers that read them.
        weights_.layers.front().skipped = weights_.layers.front().in;
        for (Layer& layer : weights_.layers)
            if (layer.skipped) layer = preparation_.encoding.arranged(layer);
        network_ = Network(weights_.layers, options.set, options.compact);
        preparation_.network = network_.view();
        // `lay_out_ranges` and `lay_out_lanes` need the padded count of outputs, which `Network` has computed.
        lay_out_ranges();
        lay_out_lanes();
        // The layers are no longer needed, because `Network` has copied the weights.
        weights_.layers.clear();
    }

    const Kernels& kernels() const { return network_.kernels_in_use(); }

    // Whether x is allowed as the number at index `k` of the parameters: see `check`.
    bool allowed(int k, float x) const {
        if (material().empty()) return parameter(k).allows(x);
        return same(x, material()[k]);
    }

    // Appends the places of a target parameter's numbers to `places_`. A place is an index in an array of all numbers
    // of `Principled`.
    void add_places(const TargetParam& p) {
        in_plane_ |= p.in_plane;
        const int first = static_cast<int>(detail::field(p.name, p.size).first);
        for (int c = 0; c < p.size; ++c) places_.push_back(first + c);
    }

    // Throws if the network contradicts the description in the file, or if this version of the runtime cannot evaluate
    // the target.
    void check_description() const {
        if (anisotropic() && (in_plane_ || !weights_.directional))
            throw Error(
                "the adapter is anisotropic, but its lobes stretch along the plane of incidence, or its network does "
                "not read the view direction; train again");
        if (weights_.dialect != DIALECT)
            throw Error("the network was trained for the Principled dialect '" + shown(weights_.dialect) +
                        "', but this version evaluates '" + DIALECT + "'");
        if (weights_.instances > MAX_INSTANCES)
            throw Error("the network blends more than " + std::to_string(MAX_INSTANCES) +
                        " instances, which this version cannot evaluate");
        if (weights_.layers.front().in != preparation_.encoding.size() || weights_.layers.back().out != output_count())
            throw Error("the network does not fit its description; train again");
    }

    // Fills in the ranges of all outputs. The outputs are the target parameters of the first instance, of the second
    // instance, and so on, and then the shares from which `assemble` computes the weights of the blend. Shares lie in 0
    // .. 1. The ranges of the padding stay 0.
    void lay_out_ranges() {
        const int count = network_.output_stride();
        ranges_ = detail::aligned<float>(5 * static_cast<std::size_t>(count));
        float *start = ranges_.get(), *slope = start + count, *factor = slope + count;
        float *rate = factor + count, *in_plane = rate + count;
        preparation_.ranges = {count, 0, start, slope, factor, rate, in_plane};
        int next = 0;
        for (int k = 0; k < weights_.instances; ++k)
            for (const TargetParam& p : weights_.target)
                for (int c = 0; c < p.size; ++c, ++next) {
                    in_plane[next] = p.in_plane;
                    (p.logarithmic ? factor : start)[next] = static_cast<float>(p.low);
                    (p.logarithmic ? rate : slope)[next] =
                        static_cast<float>(p.logarithmic ? std::log2(p.high / p.low) : p.high - p.low);
                    if (p.logarithmic) preparation_.ranges.logarithmic = next + 1;
                }
        std::fill(slope + next, slope + output_count(), 1.0f);
    }

    // Fills in `Preparation::outputs_of_lanes` and `outputs_of_pairs`. Fields that the network does not set, and lanes
    // without an instance, get the index of the first output of the padding. `Network` pads the last layer by at least
    // one neuron, so the padding has at least one output. The weights and the range of the padding are 0, so the
    // decoded value of the padding is 0.
    void lay_out_lanes() {
        const int size = static_cast<int>(places_.size()), per_pack = Blend<float>::PRINCIPLED_SIZE * LANES;
        const int zero = output_count();
        outputs_of_lanes_.assign(static_cast<std::size_t>(per_pack) * MAX_PACKS, zero);
        for (int k = 0; k < weights_.instances; ++k)
            for (int f = 0; f < size; ++f)
                outputs_of_lanes_[k / LANES * per_pack + places_[f] * LANES + k % LANES] = k * size + f;
        preparation_.outputs_of_lanes = outputs_of_lanes_.data();
        for (int at = 0; at < per_pack; at += LANES)
            outputs_of_pairs_.insert(outputs_of_pairs_.end(), {outputs_of_lanes_[at], outputs_of_lanes_[at + 1]});
        preparation_.outputs_of_pairs = outputs_of_pairs_.data();
    }

    // A direction with the cosine `cos_theta_i` and the azimuth 0. Isotropic adapters read only z, so x is set to 0 for
    // them, which saves a square root.
    Direction at_azimuth_0(float cos_theta_i) const {
        return {anisotropic() ? safe_sqrt(1.0f - cos_theta_i * cos_theta_i) : 0.0f, 0.0f, cos_theta_i};
    }

    // Calls `work(first, count, wi)` for each block of queries. `first` is the index of the block's first query.
    template <class Work>
    void in_blocks(int count, const float* cos_theta_i, const Work& work) const {
        Direction wi[BLOCK];
        for (int first = 0; first < count; first += BLOCK) {
            const int now = std::min(BLOCK, count - first);
            std::transform(cos_theta_i + first, cos_theta_i + first + now, wi,
                           [&](float cosine) { return at_azimuth_0(cosine); });
            work(first, now, wi);
        }
    }

    // The row of `parameters` that belongs to the query with index `q`.
    const float* row(const float* parameters, int q) const {
        return parameters + static_cast<std::size_t>(q) * parameter_count();
    }

    // Runs the network for at most BLOCK queries.
    void outputs_of_block(int count, const float* parameters, const Direction* wi, float* outputs) const {
        alignas(64) float inputs[BLOCK * WIDEST_LAYER];
        for (int q = 0; q < count; ++q)
            kernels().encode(preparation_, row(parameters, q), wi[q], inputs + q * network_.input_stride());
        network_.forward_many(count, inputs, outputs);
    }

    Weights weights_;
    Network network_;
    Preparation preparation_{};
    std::vector<int> places_;            // for each number of an instance: its place in `Principled`
    std::vector<int> outputs_of_lanes_;  // `Preparation::outputs_of_lanes`
    std::vector<int> outputs_of_pairs_;  // `Preparation::outputs_of_pairs`
    std::vector<std::size_t> owners_;    // for each number of the parameters: the index of the parameter
    std::unique_ptr<float[], detail::FreeAligned> ranges_;
    bool in_plane_ = false;
};

// The blends of an untextured material at many values of cos(theta_i), and the interpolation between these blends. With
// `Curves`, no network runs at the shading point. Only isotropic adapters have curves.
class Curves {
public:
    // nma/render/curves.py has the same constants. The first node has the cosine MIN_COS instead of 0.
    static constexpr int NODES = 128;
    static constexpr float MIN_COS = 1e-4f;

    // Throws `Error` if the adapter is anisotropic.
    Curves(const Adapter& adapter, const float* parameters, int nodes = NODES) {
        if (adapter.anisotropic())
            throw Error(
                "an anisotropic adapter has no curves, because the azimuth of the view matters; pass directions to "
                "`prepare`");
        for (int n = 0; n < std::max(nodes, 2); ++n) {
            const float cosine = static_cast<float>(n) / static_cast<float>(std::max(nodes, 2) - 1);
            nodes_.push_back(adapter.prepare(parameters, maximum(cosine, MIN_COS)));
        }
    }

    // The BRDF at any cos(theta_i), interpolated linearly between two nodes. NaN counts as 0. The weights of each node
    // sum to 1, so the interpolated weights sum to 1, too. The lobe probabilities of each node also sum to 1, and so do
    // the interpolated probabilities. Python (nma/render/curves.py) interpolates only the instances and weights, and
    // computes `scale` and the lobe probabilities again from the interpolated blend. This function also interpolates
    // `scale` and the probabilities, which is faster. So the results of C++ and Python differ slightly between two
    // nodes.
    Brdf at(float cos_theta_i) const {
        const float cosine = is_nan(cos_theta_i) ? 0.0f : clip(cos_theta_i, 0.0f, 1.0f);
        const float position = cosine * static_cast<float>(nodes_.size() - 1);
        const std::size_t left = std::min(static_cast<std::size_t>(position), nodes_.size() - 2);
        const Lanes<float> t = position - static_cast<float>(left);
        const Blend<float>& a = nodes_[left].blend_;
        const Blend<float>& b = nodes_[left + 1].blend_;
        Brdf made;
        made.in_plane_ = nodes_[left].in_plane_;
        made.blend_.count = a.count;
        made.blend_.under_interface = a.under_interface;
        made.blend_.interface = a.interface;
        made.blend_.scale = a.scale + (b.scale - a.scale) * t[0];
        for (int n = 0; n < a.used(); ++n) {
            const Lanes<float>* from = a.packs[n].as_array();
            const Lanes<float>* to = b.packs[n].as_array();
            Lanes<float>* between = made.blend_.packs[n].as_array();
            for (std::size_t k = 0; k < sizeof(Pack<float>) / sizeof(Lanes<float>); ++k)
                between[k] = lerp(from[k], to[k], t);
        }
        return made;
    }

private:
    std::vector<Brdf> nodes_;
};

// `Brdf::eval_pdf` and `Brdf::sample` for many shading points. The argument `u` has three uniform numbers for each
// shading point.
inline void eval_pdf_many(int count, const Brdf* brdfs, const Direction* wi, const Direction* wo, Value* values) {
    for (int k = 0; k < count; ++k) values[k] = brdfs[k].eval_pdf(wi[k], wo[k]);
}
inline void sample_many(int count, const Brdf* brdfs, const Direction* wi, const float* u, Sampled* samples) {
    for (int k = 0; k < count; ++k, u += 3) samples[k] = brdfs[k].sample(wi[k], u[0], u[1], u[2]);
}

}  // namespace nma
