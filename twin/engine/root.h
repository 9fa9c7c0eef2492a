/* Square roots of eight runs by multiplications: sqrt alone would keep the processor's divider busy while its
 * multipliers wait, so every second root of the lanes comes here. The iteration (Markstein 1990, Computation of
 * elementary functions on the IBM RISC System/6000 processor) rounds correctly: the bits are those of sqrt.
 */
#if defined(__AVX512F__)
#include <immintrin.h>

static inline tf_real tf_root_real(tf_real a) {
  const __m512d x = (__m512d)a, half = _mm512_set1_pd(0.5), y = _mm512_rsqrt14_pd(x);
  __m512d g = _mm512_mul_pd(x, y), h = _mm512_mul_pd(y, half); /* towards sqrt(x) and 1 / (2 sqrt(x)) */
  for (int i = 0; i < 2; ++i) {
    const __m512d r = _mm512_fnmadd_pd(g, h, half);
    g = _mm512_fmadd_pd(g, r, g);
    h = _mm512_fmadd_pd(h, r, h);
  }
  g = _mm512_fmadd_pd(_mm512_fnmadd_pd(g, g, x), h, g);
  const __mmask8 tame = _mm512_cmp_pd_mask(x, _mm512_set1_pd(1e-250), _CMP_GT_OQ) &
                        _mm512_cmp_pd_mask(x, _mm512_set1_pd(1e250), _CMP_LT_OQ);
  return tame == 0xff ? (tf_real)g : tf_sqrt_real(a);
}
#else
static inline tf_real tf_root_real(tf_real a) { return tf_sqrt_real(a); }
#endif
