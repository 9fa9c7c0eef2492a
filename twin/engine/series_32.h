/* The series of kernels.h for numbers of 32 bits: as those of 64 bits, but shorter. Largest errors measured
 * (docs/numerics.md): exp 1.7 ulp, log 2.0, sin and cos 2.0 to 1000 rad. */
static inline TF_VEC TF_FN(splat)(TF_NUMBER a);
static inline TF_VEC TF_FN(choose)(TF_INT mask, TF_VEC a, TF_VEC b);

#define TF_SIGN_SHIFT 30
#define TF_ROUNDER 12582912.0f /* 1.5 * 2^23 */

static inline TF_VEC TF_FN(exp)(TF_VEC x) {
  x = TF_FN(choose)(x < -87.0f, TF_FN(splat)(-87.0f), x);
  x = TF_FN(choose)(x > 88.0f, TF_FN(splat)(88.0f), x);
  const TF_VEC shifted = x * 1.44269504f + TF_ROUNDER, k = shifted - TF_ROUNDER;
  const TF_VEC r = (x - k * 0.693359375f) + k * 2.12194440e-4f;
  const TF_VEC r2 = r * r;
  const TF_VEC low = (1.0f + r) + r2 * (0.5f + r * (1.0f / 6.0f));
  const TF_VEC high = (1.0f / 24.0f + r * (1.0f / 120.0f)) + r2 * (1.0f / 720.0f + r * (1.0f / 5040.0f));
  const TF_VEC whole = low + (r2 * r2) * high;
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
