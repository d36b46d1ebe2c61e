#include "nma_c.h"

#include <cstring>
#include <new>

#include "nma.h"

struct nma_adapter {
    nma::Adapter adapter;
};
struct nma_curves {
    nma::Curves curves;
};

static_assert(sizeof(nma::Brdf) <= sizeof(nma_brdf) && alignof(nma::Brdf) <= alignof(nma_brdf),
              "a BRDF has outgrown nma_brdf: raise its number of floats in nma_c.h");
static_assert(std::is_trivially_copyable_v<nma::Brdf>);

namespace {

const nma::Brdf& of(const nma_brdf& brdf) { return *std::launder(reinterpret_cast<const nma::Brdf*>(&brdf)); }
void put(nma_brdf* to, const nma::Brdf& brdf) { new (to) nma::Brdf(brdf); }
nma::InstructionSet set_of(int value) { return static_cast<nma::InstructionSet>(value - NMA_PORTABLE); }
nma::Direction direction(const float* v) { return {v[0], v[1], v[2]}; }

constexpr int BLOCK = nma::Adapter::BLOCK;

// Calls `work(first, count)` for each block of queries. `first` is the index of the block's first query.
template <class F>
void in_blocks(int count, F work) {
    for (int first = 0; first < count; first += BLOCK) work(static_cast<size_t>(first), std::min(BLOCK, count - first));
}

// Prepares at most BLOCK queries. `views` are cosines or view directions.
template <class View>
void prepare_block(const nma::Adapter& adapter, int count, const float* parameters, const View* views,
                   nma_brdf* brdfs) {
    nma::Brdf block[BLOCK];
    adapter.prepare_many(count, parameters, views, block);
    for (int k = 0; k < count; ++k) put(brdfs + k, block[k]);
}

// At most BLOCK directions, read from rows of three floats.
struct Directions {
    nma::Direction wi[BLOCK];

    Directions(int count, const float* rows) {
        for (int k = 0; k < count; ++k) wi[k] = direction(rows + 3 * k);
    }
};

// Calls `make` with the options of the instruction set, and returns its result as an `nma_adapter`. If `make` throws,
// returns null and writes the reason to `message`.
template <class F>
nma_adapter* loaded(F make, int instruction_set, char* message, size_t size) {
    const auto fail = [&](const char* reason) -> nma_adapter* {
        if (message && size) {
            std::strncpy(message, reason, size - 1);
            message[size - 1] = '\0';
        }
        return nullptr;
    };
    nma::Options options;
    options.compact = (instruction_set & NMA_COMPACT) != 0;
    instruction_set &= ~NMA_COMPACT;
    if (instruction_set < NMA_FASTEST || instruction_set > NMA_AVX512_BF16) return fail("no such instruction set");
    if (instruction_set != NMA_FASTEST) options.set = set_of(instruction_set);
    try {
        return new nma_adapter{make(options)};
    } catch (const std::exception& e) {
        return fail(e.what());
    }
}

}  // namespace

size_t nma_brdf_size(void) { return sizeof(nma_brdf); }

int nma_supported(int set) {
    return set == NMA_FASTEST || (set >= NMA_PORTABLE && set <= NMA_AVX512_BF16 && nma::supported(set_of(set)));
}

nma_adapter* nma_load(const char* path, int set, char* message, size_t size) {
    return loaded([&](const nma::Options& options) { return nma::Adapter::load(path, options); }, set, message, size);
}

nma_adapter* nma_from_memory(const void* bytes, size_t length, int set, char* message, size_t size) {
    return loaded([&](const nma::Options& options) { return nma::Adapter::from_memory(bytes, length, options); }, set,
                  message, size);
}

void nma_free(nma_adapter* adapter) { delete adapter; }

int nma_parameter_count(const nma_adapter* a) { return a->adapter.parameter_count(); }
const char* nma_parameter_name(const nma_adapter* a, int index) { return a->adapter.parameter(index).name.c_str(); }
void nma_parameter_range(const nma_adapter* a, int index, float range[2]) {
    const nma::SourceParam& p = a->adapter.parameter(index);
    range[0] = static_cast<float>(p.low);
    range[1] = static_cast<float>(p.high);
}
int nma_single_material(const nma_adapter* a, float* parameters) {
    std::copy(a->adapter.material().begin(), a->adapter.material().end(), parameters);
    return !a->adapter.material().empty();
}
int nma_check(const nma_adapter* a, const float* parameters) { return a->adapter.check(parameters); }
void nma_clamp(const nma_adapter* a, float* parameters) { a->adapter.clamp(parameters); }
int nma_output_count(const nma_adapter* a) { return a->adapter.output_count(); }
int nma_instruction_set(const nma_adapter* a) { return static_cast<int>(a->adapter.instruction_set()) + NMA_PORTABLE; }
int nma_anisotropic(const nma_adapter* a) { return a->adapter.anisotropic(); }

void nma_prepare(const nma_adapter* a, const float* parameters, float cos_theta_i, nma_brdf* brdf) {
    put(brdf, a->adapter.prepare(parameters, cos_theta_i));
}

void nma_prepare_many(const nma_adapter* a, int count, const float* parameters, const float* cos_theta_i,
                      nma_brdf* brdfs) {
    in_blocks(count, [&](size_t first, int now) {
        prepare_block(a->adapter, now, parameters + first * a->adapter.parameter_count(), cos_theta_i + first,
                      brdfs + first);
    });
}

void nma_prepare_direction(const nma_adapter* a, const float* parameters, const float* wi, nma_brdf* brdf) {
    put(brdf, a->adapter.prepare(parameters, direction(wi)));
}

void nma_prepare_direction_many(const nma_adapter* a, int count, const float* parameters, const float* wi,
                                nma_brdf* brdfs) {
    in_blocks(count, [&](size_t first, int now) {
        const Directions rows(now, wi + 3 * first);
        prepare_block(a->adapter, now, parameters + first * a->adapter.parameter_count(), rows.wi, brdfs + first);
    });
}

void nma_outputs_many(const nma_adapter* a, int count, const float* parameters, const float* cos_theta_i,
                      float* outputs) {
    a->adapter.network_outputs_many(count, parameters, cos_theta_i, outputs);
}

void nma_outputs_direction_many(const nma_adapter* a, int count, const float* parameters, const float* wi,
                                float* outputs) {
    in_blocks(count, [&](size_t first, int now) {
        const Directions rows(now, wi + 3 * first);
        a->adapter.network_outputs_many(now, parameters + first * a->adapter.parameter_count(), rows.wi,
                                        outputs + first * a->adapter.output_count());
    });
}

nma_curves* nma_curves_new(const nma_adapter* a, const float* parameters) {
    try {
        return new nma_curves{nma::Curves(a->adapter, parameters)};
    } catch (const std::exception&) {
        return nullptr;
    }
}
void nma_curves_at(const nma_curves* curves, float cos_theta_i, nma_brdf* brdf) {
    put(brdf, curves->curves.at(cos_theta_i));
}
void nma_curves_free(nma_curves* curves) { delete curves; }

void nma_eval_pdf(int count, const nma_brdf* brdfs, const float* wi, const float* wo, float* out) {
    for (int k = 0; k < count; ++k, wi += 3, wo += 3, out += 4) {
        const nma::Value e = of(brdfs[k]).eval_pdf(direction(wi), direction(wo));
        const float row[] = {e.value.x, e.value.y, e.value.z, e.pdf};
        std::copy_n(row, 4, out);
    }
}

void nma_sample(int count, const nma_brdf* brdfs, const float* wi, const float* u, float* out) {
    for (int k = 0; k < count; ++k, wi += 3, u += 3, out += 7) {
        const nma::Sampled s = of(brdfs[k]).sample(direction(wi), u[0], u[1], u[2]);
        const float row[] = {s.wo.x, s.wo.y, s.wo.z, s.value.x, s.value.y, s.value.z, s.pdf};
        std::copy_n(row, 7, out);
    }
}

void nma_albedo(int count, const nma_brdf* brdfs, const float* wi, float* out) {
    for (int k = 0; k < count; ++k, wi += 3, out += 3) {
        const nma::Vec3<float> albedo = of(brdfs[k]).albedo(direction(wi));
        std::copy_n(&albedo.x, 3, out);
    }
}
