/* Functions of vectors of numbers, written so that every compiler and every vector width gives the same bits:
 * no library calls, no contraction, no reassociation. Taken once for each vector type, after series_64.h or
 * series_32.h, with TF_NUMBER the number, TF_VEC the vector, TF_INT that of integers as wide, TF_WIDTH its number
 * of lanes, TF_FN(name) the names, TF_LIBM(name) those of the C library, TF_SIGN_SHIFT what moves bit 1 to the sign.
 *
 * Largest error measured (docs/numerics.md): tanh 3.1 ulp, of 32 bits 3.2.
 */
#define TF_N(constant) ((TF_NUMBER)(constant))

static inline TF_VEC TF_FN(splat)(TF_NUMBER a) {
  TF_VEC r;
  for (int i = 0; i < TF_WIDTH; ++i) r[i] = a;
  return r;
}

/* The lanes of a where `mask` is set, those of b elsewhere. */
static inline TF_VEC TF_FN(choose)(TF_INT mask, TF_VEC a, TF_VEC b) {
  return (TF_VEC)((mask & (TF_INT)a) | (~mask & (TF_INT)b));
}

static inline TF_VEC TF_FN(sqrt)(TF_VEC a) {
  TF_VEC r;
  for (int i = 0; i < TF_WIDTH; ++i) r[i] = TF_LIBM(sqrt)(a[i]);
  return r;
}

static inline TF_VEC TF_FN(sin)(TF_VEC x) {
  TF_VEC shifted;
  const TF_VEC r = TF_FN(quarter)(x, &shifted);
  const TF_VEC value = TF_FN(choose)(((TF_INT)shifted & 1) == 0, TF_FN(sine)(r), TF_FN(cosine)(r));
  return (TF_VEC)((TF_INT)value ^ (((TF_INT)shifted & 2) << TF_SIGN_SHIFT));
}

static inline TF_VEC TF_FN(cos)(TF_VEC x) {
  TF_VEC shifted;
  const TF_VEC r = TF_FN(quarter)(x, &shifted);
  const TF_VEC value = TF_FN(choose)(((TF_INT)shifted & 1) == 0, TF_FN(cosine)(r), TF_FN(sine)(r));
  return (TF_VEC)((TF_INT)value ^ ((((TF_INT)shifted + 1) & 2) << TF_SIGN_SHIFT));
}

/* tanh(x) = (1 - e) / (1 + e), e = exp(-2 |x|); near zero, where that cancels, its continued fraction (Lambert). */
static inline TF_VEC TF_FN(tanh)(TF_VEC x) {
  const TF_INT sign = (TF_INT)x & (TF_INT)TF_FN(splat)(TF_N(-0.0));
  const TF_VEC a = (TF_VEC)((TF_INT)x ^ sign), e = TF_FN(exp)(TF_N(-2) * a), z = x * x;
  const TF_VEC far = (TF_VEC)((TF_INT)((TF_N(1) - e) / (TF_N(1) + e)) | sign);
  const TF_VEC near = x * (TF_N(135135) + z * (TF_N(17325) + z * (TF_N(378) + z))) /
                      (TF_N(135135) + z * (TF_N(62370) + z * (TF_N(3150) + z * TF_N(28))));
  return TF_FN(choose)(a < TF_N(0.4), near, far);
}

/* Functions that the model uses nowhere today, by the C library. */
#define TF_BY_LANE_1(name)                                         \
  static inline TF_VEC TF_FN(name)(TF_VEC a) {                     \
    TF_VEC r;                                                      \
    for (int i = 0; i < TF_WIDTH; ++i) r[i] = TF_LIBM(name)(a[i]); \
    return r;                                                      \
  }
#define TF_BY_LANE_2(name)                                               \
  static inline TF_VEC TF_FN(name)(TF_VEC a, TF_VEC b) {                 \
    TF_VEC r;                                                            \
    for (int i = 0; i < TF_WIDTH; ++i) r[i] = TF_LIBM(name)(a[i], b[i]); \
    return r;                                                            \
  }
TF_BY_LANE_1(tan) TF_BY_LANE_1(asin) TF_BY_LANE_1(acos) TF_BY_LANE_1(atan) TF_BY_LANE_1(sinh) TF_BY_LANE_1(cosh)
TF_BY_LANE_1(erf) TF_BY_LANE_1(floor) TF_BY_LANE_1(ceil) TF_BY_LANE_1(fabs)
TF_BY_LANE_2(fmin) TF_BY_LANE_2(fmax) TF_BY_LANE_2(atan2)
