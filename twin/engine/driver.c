/* Fixed-step RK4 around the generated right-hand side tf_rhs(x, u, vehicle, soil).
 *
 * Inputs are linear between samples. Soil parameters follow the route: at the
 * coordinate c = time_weight * t + travel_weight * travel they are joined
 * smoothly (3 w^2 - 2 w^3) between the knots of the route table.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* TF_NX states, TF_NU inputs, TF_NP soil parameters and the index TF_TRAVEL are
 * defined ahead of this file from the names in dynamics.py. */

typedef struct {
  const double *vehicle;
  double time_weight, travel_weight;
  long knots;
  const double *at;    /* (knots,) coordinates, increasing */
  const double *table; /* (knots, TF_NP) soil parameters */
  double soil[TF_NP];
  int *iw;
  double *w;
} tf_run;

static void tf_soil(tf_run *run, double t, const double *x) {
  const double c = run->time_weight * t + run->travel_weight * x[TF_TRAVEL];
  long k = 0;
  while (k < run->knots - 1 && c >= run->at[k + 1]) ++k;
  const double *row = run->table + k * TF_NP;
  if (k == run->knots - 1 || c <= run->at[0]) {
    memcpy(run->soil, row, sizeof run->soil);
    return;
  }
  double s = (c - run->at[k]) / (run->at[k + 1] - run->at[k]);
  s = s * s * (3.0 - 2.0 * s);
  for (int i = 0; i < TF_NP; ++i) run->soil[i] = row[i] + s * (row[i + TF_NP] - row[i]);
}

static void tf_slope(tf_run *run, double t, const double *x, const double *u, double *dx) {
  const double *arg[16] = {x, u, run->vehicle, run->soil};
  double *res[8] = {dx};
  tf_soil(run, t, x);
  tf_rhs(arg, res, run->iw, run->w, 0);
}

static void tf_rk4(tf_run *run, double t, double h, double *x, double u[3][TF_NU]) {
  double k1[TF_NX], k2[TF_NX], k3[TF_NX], k4[TF_NX], y[TF_NX];
  int i;
  tf_slope(run, t, x, u[0], k1);
  for (i = 0; i < TF_NX; ++i) y[i] = x[i] + 0.5 * h * k1[i];
  tf_slope(run, t + 0.5 * h, y, u[1], k2);
  for (i = 0; i < TF_NX; ++i) y[i] = x[i] + 0.5 * h * k2[i];
  tf_slope(run, t + 0.5 * h, y, u[1], k3);
  for (i = 0; i < TF_NX; ++i) y[i] = x[i] + h * k3[i];
  tf_slope(run, t + h, y, u[2], k4);
  for (i = 0; i < TF_NX; ++i) x[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
}

/* Samples x(t0 + i dt), i = 0..n, into out (n + 1, TF_NX); out[0] holds x(t0) on entry.
 * Returns n, or the number of the last finite sample, or -1 when memory ran out. */
#if defined(_WIN32)
__declspec(dllexport)
#endif
long tf_simulate(long n, long substeps, double t0, double dt, const double *inputs, const double *vehicle,
                 double *out, double time_weight, double travel_weight, long knots, const double *at,
                 const double *table) {
  tf_run run = {vehicle, time_weight, travel_weight, knots, at, table, {0}, 0, 0};
  casadi_int sz_arg, sz_res, sz_iw, sz_w;
  tf_rhs_work(&sz_arg, &sz_res, &sz_iw, &sz_w);
  run.iw = malloc(sizeof(int) * (size_t)(sz_iw + 1));
  run.w = malloc(sizeof(double) * (size_t)(sz_w + 1));
  if (!run.iw || !run.w) {
    free(run.iw);
    free(run.w);
    return -1;
  }
  const double h = dt / (double)substeps;
  long i = 0;
  for (; i < n; ++i) {
    double x[TF_NX], u[3][TF_NU];
    const double *a = inputs + i * TF_NU, *b = a + TF_NU;
    memcpy(x, out + i * TF_NX, sizeof x);
    for (long j = 0; j < substeps; ++j) {
      for (int m = 0; m < 3; ++m) {
        const double f = ((double)j + 0.5 * m) / (double)substeps;
        for (int c = 0; c < TF_NU; ++c) u[m][c] = a[c] + f * (b[c] - a[c]);
      }
      tf_rk4(&run, t0 + (double)i * dt + (double)j * h, h, x, u);
    }
    double sum = 0.0;
    for (int c = 0; c < TF_NX; ++c) sum += x[c];
    if (!isfinite(sum)) break;
    memcpy(out + (i + 1) * TF_NX, x, sizeof x);
  }
  free(run.iw);
  free(run.w);
  return i;
}
