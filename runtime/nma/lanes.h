// `Lanes<T>` is a vector of four numbers of type T. With `Lanes<T>` as their number type, the functions of
// generated/target.h evaluate four instances at once.
//
// With GCC and Clang, four floats are in a vector register, because every CPU of the target architecture has vector
// registers of this size. Four doubles are in an array. With other compilers, four floats are in an array, too.
#pragma once

#include <cstdint>

#include "math.h"

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace nma {

constexpr int LANES = 4;

namespace detail {

// Four numbers in an array, for types and compilers without vector registers.
template <class T>
struct Four {
    T lane[LANES];

    T& operator[](int k) { return lane[k]; }
    constexpr T operator[](int k) const { return lane[k]; }
};

template <class T, class F>
inline Four<T> each(F function) {
    return {{function(0), function(1), function(2), function(3)}};
}
template <class T> inline Four<T> operator+(const Four<T>& a, const Four<T>& b) {
    return each<T>([&](int k) { return a[k] + b[k]; });
}
template <class T> inline Four<T> operator-(const Four<T>& a, const Four<T>& b) {
    return each<T>([&](int k) { return a[k] - b[k]; });
}
template <class T> inline Four<T> operator*(const Four<T>& a, const Four<T>& b) {
    return each<T>([&](int k) { return a[k] * b[k]; });
}
template <class T> inline Four<T> operator/(const Four<T>& a, const Four<T>& b) {
    return each<T>([&](int k) { return a[k] / b[k]; });
}
template <class T> inline Four<T> least(const Four<T>& a, const Four<T>& b) {
    return each<T>([&](int k) { return minimum(a[k], b[k]); });
}
template <class T> inline Four<T> most(const Four<T>& a, const Four<T>& b) {
    return each<T>([&](int k) { return maximum(a[k], b[k]); });
}
template <class T> inline Four<T> roots(const Four<T>& a) {
    return each<T>([&](int k) { return std::sqrt(a[k]); });
}
template <class T> inline Four<T> sums(const Four<T>& a, const Four<T>& b, const Four<T>& c, const Four<T>& d) {
    const auto sum = [](const Four<T>& v) { return (v[0] + v[2]) + (v[1] + v[3]); };
    return {{sum(a), sum(b), sum(c), sum(d)}};
}
template <class T> inline Four<T> logarithms(const Four<T>& a) {
    return each<T>([&](int k) { return std::log(a[k]); });
}

template <class T> inline Four<T> exponentials(const Four<T>& a) {
    return each<T>([&](int k) { return std::exp(a[k]); });
}

template <class T>
struct Storage {
    using Type = Four<T>;
};

#if defined(__GNUC__)
typedef float Floats __attribute__((vector_size(16)));
typedef std::int32_t Whole __attribute__((vector_size(16)));

template <>
struct Storage<float> {
    using Type = Floats;
};

#if defined(__SSE2__)
inline Floats least(Floats a, Floats b) { return (Floats)_mm_min_ps((__m128)b, (__m128)a); }
inline Floats most(Floats a, Floats b) { return (Floats)_mm_max_ps((__m128)b, (__m128)a); }
inline Floats roots(Floats a) { return (Floats)_mm_sqrt_ps((__m128)a); }
inline Floats sums(Floats a, Floats b, Floats c, Floats d) {
    const __m128 ab = _mm_add_ps(_mm_unpacklo_ps((__m128)a, (__m128)b), _mm_unpackhi_ps((__m128)a, (__m128)b));
    const __m128 cd = _mm_add_ps(_mm_unpacklo_ps((__m128)c, (__m128)d), _mm_unpackhi_ps((__m128)c, (__m128)d));
    return (Floats)_mm_add_ps(_mm_movelh_ps(ab, cd), _mm_movehl_ps(cd, ab));
}
inline Whole nearest(Floats a) { return (Whole)_mm_cvtps_epi32((__m128)a); }
#elif defined(__aarch64__)
inline Floats least(Floats a, Floats b) { return b < a ? b : a; }
inline Floats most(Floats a, Floats b) { return a < b ? b : a; }
inline Floats roots(Floats a) { return (Floats)vsqrtq_f32((float32x4_t)a); }
inline Floats sums(Floats a, Floats b, Floats c, Floats d) {
    return (Floats)vpaddq_f32(vpaddq_f32((float32x4_t)a, (float32x4_t)b), vpaddq_f32((float32x4_t)c, (float32x4_t)d));
}
inline Whole nearest(Floats a) { return (Whole)vcvtnq_s32_f32((float32x4_t)a); }
#else
inline Floats least(Floats a, Floats b) { return b < a ? b : a; }
inline Floats most(Floats a, Floats b) { return a < b ? b : a; }
inline Floats roots(Floats a) { return Floats{std::sqrt(a[0]), std::sqrt(a[1]), std::sqrt(a[2]), std::sqrt(a[3])}; }
inline Floats sums(Floats a, Floats b, Floats c, Floats d) {
    const auto sum = [](Floats v) { return (v[0] + v[2]) + (v[1] + v[3]); };
    return Floats{sum(a), sum(b), sum(c), sum(d)};
}
inline Whole nearest(Floats a) {
    const Floats half = a < 0.0f ? Floats{-0.5f, -0.5f, -0.5f, -0.5f} : Floats{0.5f, 0.5f, 0.5f, 0.5f};
    return __builtin_convertvector(a + half, Whole);
}
#endif

// Natural logarithms, to two units in the last place for normal numbers. The result for 0 is less than -88. The
// argument is split into a power of 2 and a mantissa 1 + x in sqrt(1/2) .. sqrt(2). The logarithm of 1 + x is x - x^2 /
// 2 plus x^3 times a polynomial (that of `logf` in Cephes), whose terms are summed in pairs, which takes less time than
// a division.
inline Floats logarithms(Floats a) {
    const Whole bits = (Whole)a, halves = (bits - 0x3f3504f3) >> 23;
    const Floats x = (Floats)(bits - (halves << 23)) - 1.0f, exponent = __builtin_convertvector(halves, Floats);
    const Floats x2 = x * x, x4 = x2 * x2;
    const Floats low = (0.33333331174f - x * 0.24999993993f) + x2 * (0.20000714765f - x * 0.16668057665f);
    const Floats high = (0.14249322787f - x * 0.12420140846f) + x2 * (0.1167699874f - x * 0.1151461031f);
    const Floats series = low + x4 * (high + x4 * 0.070376836292f);
    return exponent * 0.693147181f + (x + x2 * (x * series - 0.5f));
}

// e^a, to two units in the last place for |a| <= 87. The result is 2^n e^r with a whole number n and r = a - n log(2),
// where |r| is at most log(2) / 2 and e^r is computed as a power series.
inline Floats exponentials(Floats a) {
    const Whole n = nearest(a * 1.44269504f);
    const Floats whole = __builtin_convertvector(n, Floats);
    const Floats r = a - whole * 0.693145752f - whole * 1.42860677e-6f, r2 = r * r;
    const Floats low = (1.0f + r) + r2 * (0.5f + r * 0.166666667f);
    const Floats high = (0.0416666667f + r * 0.00833333333f) + r2 * (0.00138888889f + r * 1.98412698e-4f);
    return (low + high * (r2 * r2)) * (Floats)((n + 127) << 23);
}
#endif

}  // namespace detail

template <class T>
struct Lanes {
    typename detail::Storage<T>::Type v;

    Lanes() = default;
    constexpr Lanes(T x) : v{x, x, x, x} {}
    constexpr Lanes(T a, T b, T c, T d) : v{a, b, c, d} {}
    constexpr Lanes(typename detail::Storage<T>::Type four) : v(four) {}

    T operator[](int k) const { return v[k]; }
    void set(int k, T x) { v[k] = x; }
    Lanes& operator+=(const Lanes& a) { return *this = v + a.v; }
};

template <class T> constexpr Lanes<T> PI<Lanes<T>> = Lanes<T>(PI<T>);
template <class T> constexpr Lanes<T> INV_PI<Lanes<T>> = Lanes<T>(INV_PI<T>);

template <class T> inline Lanes<T> operator+(const Lanes<T>& a, const Lanes<T>& b) { return a.v + b.v; }
template <class T> inline Lanes<T> operator-(const Lanes<T>& a, const Lanes<T>& b) { return a.v - b.v; }
template <class T> inline Lanes<T> operator*(const Lanes<T>& a, const Lanes<T>& b) { return a.v * b.v; }
template <class T> inline Lanes<T> operator/(const Lanes<T>& a, const Lanes<T>& b) { return a.v / b.v; }
template <class T> inline Lanes<T> operator-(const Lanes<T>& a) { return Lanes<T>(T(0)) - a; }

template <class T> inline Lanes<T> minimum(const Lanes<T>& a, const Lanes<T>& b) { return detail::least(a.v, b.v); }
template <class T> inline Lanes<T> maximum(const Lanes<T>& a, const Lanes<T>& b) { return detail::most(a.v, b.v); }
template <class T> inline Lanes<T> sqrt(const Lanes<T>& a) { return detail::roots(a.v); }
template <class T> inline Lanes<T> log(const Lanes<T>& a) { return detail::logarithms(a.v); }
template <class T> inline Lanes<T> exp(const Lanes<T>& a) { return detail::exponentials(a.v); }
template <class T> inline Lanes<T> safe_sqrt(const Lanes<T>& a) { return sqrt(maximum(a, Lanes<T>(T(0)))); }

// The lanes 0 and 1 of `a` and the lanes 2 and 3 of `b`, and the lanes of `a` with both halves exchanged.
template <class T> inline Lanes<T> halves(const Lanes<T>& a, const Lanes<T>& b) { return {a[0], a[1], b[2], b[3]}; }
template <class T> inline Lanes<T> turned(const Lanes<T>& a) { return {a[2], a[3], a[0], a[1]}; }
template <class T> inline Vec3<Lanes<T>> halves(const Vec3<Lanes<T>>& a, const Vec3<Lanes<T>>& b) {
    return {halves(a.x, b.x), halves(a.y, b.y), halves(a.z, b.z)};
}
template <class T> inline Vec3<Lanes<T>> turned(const Vec3<Lanes<T>>& a) {
    return {turned(a.x), turned(a.y), turned(a.z)};
}

template <class T> inline T sum(const Lanes<T>& a) { return (a[0] + a[1]) + (a[2] + a[3]); }
// A vector of four numbers: the sums of the lanes of a, b, c and d.
template <class T> inline Lanes<T> sums(const Lanes<T>& a, const Lanes<T>& b, const Lanes<T>& c, const Lanes<T>& d) {
    return detail::sums(a.v, b.v, c.v, d.v);
}
template <class T> inline Vec3<T> sum(const Vec3<Lanes<T>>& a) { return {sum(a.x), sum(a.y), sum(a.z)}; }

}  // namespace nma
