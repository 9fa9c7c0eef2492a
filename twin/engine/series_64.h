/* The series of kernels.h for numbers of 64 bits. Largest errors measured (docs/numerics.md): exp 2.2 ulp, log 2.0,
 * sin and cos 2.3 to 1e5 rad. */
static inline TF_VEC TF_FN(splat)(TF_NUMBER a);
static inline TF_VEC TF_FN(choose)(TF_INT mask, TF_VEC a, TF_VEC b);

#define TF_SIGN_SHIFT 62
#define TF_ROUNDER 6755399441055744.0 /* 1.5 * 2^52: adding it rounds to the nearest integer */

/* exp(x) = 2^k exp(r), |r| <= ln 2 / 2, by its Taylor series; x is kept where the result is a normal number. */
static inline TF_VEC TF_FN(exp)(TF_VEC x) {
  x = TF_FN(choose)(x < -708.0, TF_FN(splat)(-708.0), x);
  x = TF_FN(choose)(x > 709.0, TF_FN(splat)(709.0), x);
  const TF_VEC shifted = x * 1.4426950408889634 + TF_ROUNDER, k = shifted - TF_ROUNDER;
  const TF_VEC r = (x - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10;
  const TF_VEC r2 = r * r, r4 = r2 * r2, r8 = r4 * r4;
  const TF_VEC low = (1.0 + r) + r2 * (0.5 + r * (1.0 / 6.0)) +
                     r4 * ((1.0 / 24.0 + r * (1.0 / 120.0)) + r2 * (1.0 / 720.0 + r * (1.0 / 5040.0)));
  const TF_VEC high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + r2 * (1.0 / 3628800.0 + r * (1.0 / 39916800.0)) +
                      r4 * (1.0 / 479001600.0 + r * (1.0 / 6227020800.0));
  const TF_VEC whole = low + r8 * high;
  return (TF_VEC)((TF_INT)whole + ((TF_INT)shifted << 52));
}

/* log(x) = e ln 2 + 2 artanh(f / (2 + f)), x = 2^e (1 + f), 1 + f from sqrt(1/2) to sqrt(2);
 * -inf at zero (and below the normal numbers), NaN for what is negative or no number. */
static inline TF_VEC TF_FN(log)(TF_VEC x) {
  const TF_INT above = (TF_INT)x - 0x3fe6a09e667f3bcdLL;
  const TF_INT e = above >> 52;
  const TF_VEC f = (TF_VEC)((TF_INT)x - (e << 52)) - 1.0;
  const TF_VEC k = (TF_VEC)(e + 0x4338000000000000LL) - TF_ROUNDER;
  const TF_VEC s = f / (2.0 + f), s2 = s * s, s4 = s2 * s2, s8 = s4 * s4;
  const TF_VEC low = (1.0 / 3.0 + s2 * (1.0 / 5.0)) + s4 * (1.0 / 7.0 + s2 * (1.0 / 9.0));
  const TF_VEC middle = (1.0 / 11.0 + s2 * (1.0 / 13.0)) + s4 * (1.0 / 15.0 + s2 * (1.0 / 17.0));
  const TF_VEC series = low + s8 * (middle + s8 * (1.0 / 19.0 + s2 * (1.0 / 21.0)));
  const TF_VEC near = 2.0 * s + (2.0 * s * (s2 * series) + k * 1.90821492927058770002e-10);
  const TF_VEC r = k * 6.93147180369123816490e-01 + near;
  const TF_VEC edge = TF_FN(choose)((x < 0.0) | (x != x), x - x + (0.0 * x) / 0.0, TF_FN(splat)(-HUGE_VAL));
  return TF_FN(choose)(x > 2.3e-308, r, edge);
}

/* Distance of x from the nearest multiple of pi/2 (three-part pi/2), and the multiple's integer in `shifted`. */
static inline TF_VEC TF_FN(quarter)(TF_VEC x, TF_VEC *shifted) {
  *shifted = x * 0.63661977236758134 + TF_ROUNDER;
  const TF_VEC k = *shifted - TF_ROUNDER;
  return ((x - k * 1.57079632673412561417e+00) - k * 6.07710050630396597660e-11) - k * 2.02226624879595063154e-21;
}

static inline TF_VEC TF_FN(sine)(TF_VEC r) {
  const TF_VEC z = r * r, z2 = z * z;
  const TF_VEC low = (-1.0 / 6.0 + z * (1.0 / 120.0)) + z2 * (-1.0 / 5040.0 + z * (1.0 / 362880.0));
  const TF_VEC high = (-1.0 / 39916800.0 + z * (1.0 / 6227020800.0)) +
                      z2 * (-1.0 / 1307674368000.0 + z * (1.0 / 355687428096000.0));
  return r + r * z * (low + z2 * z2 * high);
}

static inline TF_VEC TF_FN(cosine)(TF_VEC r) {
  const TF_VEC z = r * r, z2 = z * z;
  const TF_VEC low = (1.0 / 24.0 + z * (-1.0 / 720.0)) + z2 * (1.0 / 40320.0 + z * (-1.0 / 3628800.0));
  const TF_VEC high = (1.0 / 479001600.0 + z * (-1.0 / 87178291200.0)) + z2 * (1.0 / 20922789888000.0);
  return (1.0 - 0.5 * z) + z2 * (low + z2 * z2 * high);
}
