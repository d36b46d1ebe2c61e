// The multilayer perceptron: linear layers with ReLU between them. The weights are stored in the order in which the
// functions in kernels/ read them.
#pragma once

#include <memory>
#include <new>
#include <vector>

#include "kernels.h"
#include "weights.h"

namespace nma {

namespace detail {

struct FreeAligned {
    void operator()(void* memory) const { ::operator delete(memory, std::align_val_t(64)); }
};

// An array of zeros, aligned to 64 bytes as the widest vector loads require.
template <class T>
std::unique_ptr<T[], FreeAligned> aligned(std::size_t count) {
    T* memory = static_cast<T*>(::operator new(count * sizeof(T), std::align_val_t(64)));
    std::fill_n(memory, count, T(0));
    return std::unique_ptr<T[], FreeAligned>(memory);
}

// The smallest multiple of `step` that is at least `n`.
constexpr int padded(int n, int step) { return (n + step - 1) / step * step; }

// Rounds a float to bfloat16, which is the upper half of the float's bits. Rounds to nearest, ties to even.
inline std::uint32_t bfloat16(float value) { return (bits(value) + 0x7fff + (bits(value) >> 16 & 1)) >> 16; }

}  // namespace detail

// Owns the weights of a network. `view()` has pointers to the weights, which stay valid when the `Network` is moved.
class Network {
public:
    Network() = default;

    // Rounds the weights to bfloat16, which halves their memory, if `compact` is true or `set` is avx512_bf16.
    Network(const std::vector<Layer>& layers, InstructionSet set, bool compact) : kernels_(&kernels(set)) {
        if (layers.size() > DEEPEST_NETWORK)
            throw Error("the network has more than " + std::to_string(DEEPEST_NETWORK) +
                        " layers, which this version cannot run");
        view_.depth = static_cast<int>(layers.size());
        const bool pairs = kernels_->set == InstructionSet::avx512_bf16 || compact;
        const bool skip = layers.size() > 1 && layers.back().skipped > 0;
        int in = detail::padded(layers.front().in, skip ? WIDTH_STEP : INPUT_STEP);
        for (std::size_t k = 0; k < layers.size(); ++k) {
            // The output layer gets at least one neuron of padding, because `Adapter::lay_out_lanes` (nma.h) needs an
            // output whose decoded value is 0. The decoded value of the padding is 0, because the padding has the range
            // 0 in `Ranges`.
            const bool last = k + 1 == layers.size();
            const int out = layers[k].out + (last ? 1 : 0);
            if (last && skip) in += view_.layers[0].in;
            if (in > WIDEST_LAYER || out > WIDEST_LAYER)
                throw Error("the network is too wide: this version runs at most " + std::to_string(WIDEST_LAYER) +
                            " inputs, neurons in a hidden layer, and " + std::to_string(WIDEST_LAYER - 1) + " outputs");
            LayerView& view = view_.layers[k];
            view = {in, detail::padded(out, last ? kernels_->lanes : WIDTH_STEP), nullptr, nullptr, nullptr, nullptr};
            view.bias = keep(layers[k].bias, view.width);
            if (pairs) view.pairs = keep_pairs(layers[k], view);
            else view.columns = keep_columns(layers[k], view);
            in = view.width;
        }
        const auto narrow = [](const LayerView& layer) { return layer.width == NARROW; };
        view_.narrow = !pairs && std::all_of(view_.layers, view_.layers + view_.depth, narrow);
        if (view_.narrow)
            for (int k = 0; k < view_.depth; ++k) view_.layers[k].diagonals = keep_diagonals(view_.layers[k]);
    }

    InstructionSet instruction_set() const { return kernels_->set; }
    const Kernels& kernels_in_use() const { return *kernels_; }
    const NetworkView& view() const { return view_; }

    // The counts of a query's inputs and outputs, including the padding. The padding of the inputs must be 0. The
    // padding of the outputs has at least one number, and all numbers of the padding are 0.
    int input_stride() const { return view_.layers[0].in; }
    int output_stride() const { return view_.layers[view_.depth - 1].width; }

    // `outputs` must be aligned to 64 bytes.
    void forward(const float* inputs, float* outputs) const { kernels_->forward(view_, inputs, outputs); }
    void forward_many(int queries, const float* inputs, float* outputs) const {
        kernels_->forward_many(view_, queries, inputs, input_stride(), outputs, output_stride());
    }

private:
    // A new array of `count` zeros. `kept` owns the array.
    template <class T>
    T* room(std::vector<std::unique_ptr<T[], detail::FreeAligned>>& kept, std::size_t count) {
        kept.push_back(detail::aligned<T>(count));
        return kept.back().get();
    }

    // The functions `keep...` copy weights into the orders that layout.h explains.
    const float* keep(const std::vector<float>& values, int width) {
        float* to = room(floats_, width);
        std::copy(values.begin(), values.end(), to);
        return to;
    }

    // The column of input i of a layer. The inputs of the network, which are last in files, come first.
    static int column(const Layer& layer, int i) {
        const int neurons = layer.in - layer.skipped;
        return i < neurons ? detail::padded(layer.skipped, WIDTH_STEP) + i : i - neurons;
    }

    const float* keep_columns(const Layer& layer, const LayerView& view) {
        float* to = room(floats_, static_cast<std::size_t>(view.in) * view.width);
        for (int j = 0; j < layer.out; ++j)
            for (int i = 0; i < layer.in; ++i) to[column(layer, i) * view.width + j] = layer.matrix[j * layer.in + i];
        return to;
    }

    const float* keep_diagonals(const LayerView& view) {
        float* to = room(floats_, static_cast<std::size_t>(view.in) * view.width);
        // In the notation of layout.h, i = 4 b + r and j = 4 g + k.
        for (int i = 0; i < view.in; ++i)
            for (int j = 0; j < view.width; ++j) {
                const int input = i / 4 * 4 + j % 4, neuron = j / 4 * 4 + (j + i) % 4;
                to[(j / WIDTH_STEP * view.in + i) * WIDTH_STEP + j % WIDTH_STEP] =
                    view.columns[input * view.width + neuron];
            }
        return to;
    }

    const std::uint32_t* keep_pairs(const Layer& layer, const LayerView& view) {
        std::uint32_t* to = room(pairs_, static_cast<std::size_t>(view.in / 2) * view.width);
        for (int j = 0; j < layer.out; ++j)
            for (int i = 0; i < layer.in; ++i) {
                const int at = column(layer, i);
                to[at / 2 * view.width + j] |= detail::bfloat16(layer.matrix[j * layer.in + i]) << 16 * (at % 2);
            }
        return to;
    }

    const Kernels* kernels_ = nullptr;
    NetworkView view_{};
    std::vector<std::unique_ptr<float[], detail::FreeAligned>> floats_;
    std::vector<std::unique_ptr<std::uint32_t[], detail::FreeAligned>> pairs_;
};

}  // namespace nma
