/* Readings of the sensors at n samples of one run, TF_RUNS samples at a time.
 *
 * Ahead of this file stand the sizes from layout.py (TF_NX states, TF_NU inputs, TF_NV vehicle, TF_NP soil and
 * TF_NM mounting parameters, TF_NE effects, TF_NY readings), the types and the functions tf_once and tf_each.
 */
#if defined(_WIN32)
#define TF_EXPORT __declspec(dllexport)
#else
#define TF_EXPORT __attribute__((visibility("default")))
#endif

static void tf_all_lanes(tf_real *to, const double *from, long count) {
  for (long c = 0; c < count; ++c)
    for (int i = 0; i < TF_RUNS; ++i) ((double *)(to + c))[i] = from[c];
}

/* x (n, TF_NX), u (n, TF_NU), y (n, TF_NY); row i of the soil (TF_NP) begins at i * soil_step. */
TF_EXPORT void tf_read(long n, const double *x, const double *u, const double *soil, long soil_step,
                       const double *vehicle, const double *effects, const double *mounting, double *y) {
  tf_real xs[TF_NX], us[TF_NU], ps[TF_NP * TF_WHEELS], vs[TF_NV], es[TF_NE + 1], ms[TF_NM], ys[TF_NY];
  tf_real held[TF_KEPT_HELD], local[TF_KEPT_LOCAL];
  tf_all_lanes(vs, vehicle, TF_NV);
  tf_all_lanes(es, effects, TF_NE);
  tf_all_lanes(ms, mounting, TF_NM);
  for (long first = 0; first < n; first += TF_RUNS) {
    for (int i = 0; i < TF_RUNS; ++i) {
      const long row = first + i < n ? first + i : n - 1;
      for (int c = 0; c < TF_NX; ++c) ((double *)(xs + c))[i] = x[row * TF_NX + c];
      for (int c = 0; c < TF_NU; ++c) ((double *)(us + c))[i] = u[row * TF_NU + c];
      if (first == 0 || soil_step)
        for (int c = 0; c < TF_NP * TF_WHEELS; ++c) ((double *)(ps + c))[i] = soil[row * soil_step + c / TF_WHEELS];
    }
    if (first == 0) tf_once(vs, es, ps, ms, held);
    tf_each(xs, us, vs, es, ps, ms, held, local, ys);
    for (int i = 0; i < TF_RUNS && first + i < n; ++i)
      for (int c = 0; c < TF_NY; ++c) y[(first + i) * TF_NY + c] = ((const double *)(ys + c))[i];
  }
}
