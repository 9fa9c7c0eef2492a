/* The functions of kernels.h for vectors of numbers of 32 bits (TF_INT: of 32-bit integers), for runs that need
 * no more: shorter series, half the bits, twice the lanes. The same rules hold. Largest errors measured
 * (docs/numerics.md): exp 1.7 ulp, log 2.0, sin and cos 2.0 to 1000 rad, tanh 3.2.
 */
static inline TF_VEC TF_FN(splat)(float a) {
  TF_VEC r;
  for (int i = 0; i < TF_WIDTH; ++i) r[i] = a;
  return r;
}
static inline TF_VEC TF_FN(choose)(TF_INT mask, TF_VEC a, TF_VEC b) {
  return (TF_VEC)((mask & (TF_INT)a) | (~mask & (TF_INT)b));
}
static inline TF_VEC TF_FN(sqrt)(TF_VEC a) {
  TF_VEC r;
  for (int i = 0; i < TF_WIDTH; ++i) r[i] = sqrtf(a[i]);
  return r;
}
#define TF_ROUNDER 12582912.0f
static inline TF_VEC TF_FN(exp)(TF_VEC x) {
  x = TF_FN(choose)(x < -87.0f, TF_FN(splat)(-87.0f), x);
  x = TF_FN(choose)(x > 88.0f, TF_FN(splat)(88.0f), x);
  const TF_VEC shifted = x * 1.44269504f + TF_ROUNDER, k = shifted - TF_ROUNDER;
  const TF_VEC r = (x - k * 0.693359375f) + k * 2.12194440e-4f;
  const TF_VEC r2 = r * r;
  const TF_VEC whole = ((1.0f + r) + r2 * (0.5f + r * (1.0f / 6.0f))) + (r2 * r2) * ((1.0f / 24.0f + r * (1.0f / 120.0f)) + r2 * (1.0f / 720.0f + r * (1.0f / 5040.0f)));
  return (TF_VEC)((TF_INT)whole + ((TF_INT)shifted << 23));
}
static inline TF_VEC TF_FN(log)(TF_VEC x) {
  const TF_INT above = (TF_INT)x - 0x3f3504f3;
  const TF_INT e = above >> 23;
  const TF_VEC f = (TF_VEC)((TF_INT)x - (e << 23)) - 1.0f;
  const TF_VEC k = (TF_VEC)(e + 0x4b400000) - TF_ROUNDER;
  const TF_VEC s = f / (2.0f + f), s2 = s * s;
  const TF_VEC series = (1.0f / 3.0f + s2 * (1.0f / 5.0f)) + (s2 * s2) * (1.0f / 7.0f + s2 * (1.0f / 9.0f));
  const TF_VEC near = 2.0f * s + (2.0f * s * (s2 * series) + k * -2.12194440e-4f);
  const TF_VEC r = k * 0.693359375f + near;
  const TF_VEC edge = TF_FN(choose)((x < 0.0f) | (x != x), x - x + (0.0f * x) / 0.0f, TF_FN(splat)(-HUGE_VALF));
  return TF_FN(choose)(x > 1.2e-38f, r, edge);
}
static inline TF_VEC TF_FN(quarter)(TF_VEC x, TF_VEC *shifted) {
  *shifted = x * 0.636619772f + TF_ROUNDER;
  const TF_VEC k = *shifted - TF_ROUNDER;
  return ((x - k * 1.5703125f) - k * 4.8351288e-4f) - k * 3.1391647e-7f;
}
static inline TF_VEC TF_FN(sine)(TF_VEC r) {
  const TF_VEC z = r * r;
  return r + r * z * ((-1.0f / 6.0f + z * (1.0f / 120.0f)) + (z * z) * (-1.0f / 5040.0f + z * (1.0f / 362880.0f)));
}
static inline TF_VEC TF_FN(cosine)(TF_VEC r) {
  const TF_VEC z = r * r;
  return (1.0f - 0.5f * z) + (z * z) * ((1.0f / 24.0f + z * (-1.0f / 720.0f)) + (z * z) * (1.0f / 40320.0f));
}
static inline TF_VEC TF_FN(sin)(TF_VEC x) {
  TF_VEC shifted;
  const TF_VEC r = TF_FN(quarter)(x, &shifted);
  const TF_VEC value = TF_FN(choose)(((TF_INT)shifted & 1) == 0, TF_FN(sine)(r), TF_FN(cosine)(r));
  return (TF_VEC)((TF_INT)value ^ (((TF_INT)shifted & 2) << 30));
}
static inline TF_VEC TF_FN(cos)(TF_VEC x) {
  TF_VEC shifted;
  const TF_VEC r = TF_FN(quarter)(x, &shifted);
  const TF_VEC value = TF_FN(choose)(((TF_INT)shifted & 1) == 0, TF_FN(cosine)(r), TF_FN(sine)(r));
  return (TF_VEC)((TF_INT)value ^ ((((TF_INT)shifted + 1) & 2) << 30));
}
static inline TF_VEC TF_FN(tanh)(TF_VEC x) {
  const TF_INT sign = (TF_INT)x & (TF_INT)TF_FN(splat)(-0.0f);
  const TF_VEC a = (TF_VEC)((TF_INT)x ^ sign), e = TF_FN(exp)(-2.0f * a), z = x * x;
  const TF_VEC far = (TF_VEC)((TF_INT)((1.0f - e) / (1.0f + e)) | sign);
  const TF_VEC near = x * (135135.0f + z * (17325.0f + z * (378.0f + z))) /
                      (135135.0f + z * (62370.0f + z * (3150.0f + z * 28.0f)));
  return TF_FN(choose)(a < 0.4f, near, far);
}
#define TF_BY_LANE_1(name)                             \
  static inline TF_VEC TF_FN(name)(TF_VEC a) {         \
    TF_VEC r;                                          \
    for (int i = 0; i < TF_WIDTH; ++i) r[i] = name##f(a[i]); \
    return r;                                          \
  }
#define TF_BY_LANE_2(name)                             \
  static inline TF_VEC TF_FN(name)(TF_VEC a, TF_VEC b) { \
    TF_VEC r;                                          \
    for (int i = 0; i < TF_WIDTH; ++i) r[i] = name##f(a[i], b[i]); \
    return r;                                          \
  }
TF_BY_LANE_1(tan) TF_BY_LANE_1(asin) TF_BY_LANE_1(acos) TF_BY_LANE_1(atan) TF_BY_LANE_1(sinh) TF_BY_LANE_1(cosh)
TF_BY_LANE_1(erf) TF_BY_LANE_1(floor) TF_BY_LANE_1(ceil) TF_BY_LANE_1(fabs)
TF_BY_LANE_2(fmin) TF_BY_LANE_2(fmax) TF_BY_LANE_2(atan2)
