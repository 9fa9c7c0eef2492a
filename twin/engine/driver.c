/* Fixed-step RK4 around the generated right-hand side tf_rhs(x, u, vehicle, soil, effects).
 *
 * Inputs are linear between samples. Each wheel has its own soil: at the coordinate
 * c = time_weight * t + travel_weight * (travel + its distance ahead of the body origin) the
 * parameters are joined smoothly (3 w^2 - 2 w^3) between the knots of the route table, then
 * varied by the field of the plane, whose value is taken at the start of a step.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* The sizes TF_NX, TF_NU, TF_NP (soil parameters) and the indices TF_X, TF_Y, TF_YAW, TF_TRAVEL,
 * TF_WHEELBASE and TF_TRACK are defined ahead of this file from the names in layout.py. */
#define TF_WHEELS 4

typedef struct {
  const double *vehicle, *effects;
  double time_weight, travel_weight;
  long knots;
  const double *at;    /* (knots,) coordinates, increasing */
  const double *table; /* (knots, TF_NP) soil parameters */
  long rows, columns;  /* of the field's grid; no field where rows is 0 */
  double cell;
  const double *log_gain, *patch_share; /* (rows, columns), periodic */
  const double *response, *patch_soil;  /* (TF_NP,) */
} tf_plant;

typedef struct {
  const tf_plant *plant;
  double ahead[TF_WHEELS], left[TF_WHEELS]; /* hubs from the body origin */
  double gain[TF_WHEELS][TF_NP], share[TF_WHEELS];
  double soil[TF_WHEELS * TF_NP];
  int *iw;
  double *w;
} tf_run;

static void tf_start(tf_run *run, const tf_plant *plant) {
  static const double sx[TF_WHEELS] = {0.5, 0.5, -0.5, -0.5}, sy[TF_WHEELS] = {0.5, -0.5, 0.5, -0.5};
  run->plant = plant;
  for (int k = 0; k < TF_WHEELS; ++k) {
    run->ahead[k] = sx[k] * plant->vehicle[TF_WHEELBASE];
    run->left[k] = sy[k] * plant->vehicle[TF_TRACK];
    memcpy(run->soil + k * TF_NP, plant->table, sizeof(double) * TF_NP);
  }
}

/* Value of a periodic grid at cell coordinates (column, row), bilinear. */
static double tf_grid(const tf_plant *plant, const double *grid, double column, double row) {
  const double c0 = floor(column), r0 = floor(row), fc = column - c0, fr = row - r0;
  const long w = plant->columns, h = plant->rows;
  const long i = (long)(c0 - (double)w * floor(c0 / (double)w)), j = (long)(r0 - (double)h * floor(r0 / (double)h));
  const long i1 = (i + 1) % w, j1 = (j + 1) % h;
  return (1.0 - fr) * ((1.0 - fc) * grid[j * w + i] + fc * grid[j * w + i1]) +
         fr * ((1.0 - fc) * grid[j1 * w + i] + fc * grid[j1 * w + i1]);
}

static void tf_field(tf_run *run, const double *x) {
  const tf_plant *plant = run->plant;
  const double cosine = cos(x[TF_YAW]), sine = sin(x[TF_YAW]);
  for (int k = 0; k < TF_WHEELS; ++k) {
    const double px = (x[TF_X] + cosine * run->ahead[k] - sine * run->left[k]) / plant->cell;
    const double py = (x[TF_Y] + sine * run->ahead[k] + cosine * run->left[k]) / plant->cell;
    const double g = tf_grid(plant, plant->log_gain, px, py);
    run->share[k] = tf_grid(plant, plant->patch_share, px, py);
    for (int i = 0; i < TF_NP; ++i) run->gain[k][i] = plant->response[i] == 0.0 ? 1.0 : exp(plant->response[i] * g);
  }
}

static void tf_soil(tf_run *run, double t, const double *x) {
  const tf_plant *plant = run->plant;
  if (plant->knots == 1 && plant->rows == 0) return; /* set once in tf_start */
  for (int wheel = 0; wheel < TF_WHEELS; ++wheel) {
    double *soil = run->soil + wheel * TF_NP;
    const double c = plant->time_weight * t + plant->travel_weight * (x[TF_TRAVEL] + run->ahead[wheel]);
    long k = 0;
    while (k < plant->knots - 1 && c >= plant->at[k + 1]) ++k;
    const double *row = plant->table + k * TF_NP;
    if (k == plant->knots - 1 || c <= plant->at[0]) {
      memcpy(soil, row, sizeof(double) * TF_NP);
    } else {
      double s = (c - plant->at[k]) / (plant->at[k + 1] - plant->at[k]);
      s = s * s * (3.0 - 2.0 * s);
      for (int i = 0; i < TF_NP; ++i) soil[i] = row[i] + s * (row[i + TF_NP] - row[i]);
    }
    if (plant->rows > 0)
      for (int i = 0; i < TF_NP; ++i)
        soil[i] = run->gain[wheel][i] * soil[i] + run->share[wheel] * (plant->patch_soil[i] - run->gain[wheel][i] * soil[i]);
  }
}

static void tf_slope(tf_run *run, double t, const double *x, const double *u, double *dx) {
  const double *arg[32] = {x, u, run->plant->vehicle, run->soil, run->plant->effects};
  double *res[8] = {dx};
  tf_soil(run, t, x);
  tf_rhs(arg, res, run->iw, run->w, 0);
}

static void tf_rk4(tf_run *run, double t, double h, double *x, double u[3][TF_NU]) {
  double k1[TF_NX], k2[TF_NX], k3[TF_NX], k4[TF_NX], y[TF_NX];
  int i;
  if (run->plant->rows > 0) tf_field(run, x);
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
long tf_simulate(const tf_plant *plant, long n, long substeps, double t0, double dt, const double *inputs,
                 double *out) {
  tf_run run;
  casadi_int sz_arg, sz_res, sz_iw, sz_w;
  tf_rhs_work(&sz_arg, &sz_res, &sz_iw, &sz_w);
  run.iw = malloc(sizeof(int) * (size_t)(sz_iw + 1));
  run.w = malloc(sizeof(double) * (size_t)(sz_w + 1));
  if (!run.iw || !run.w) {
    free(run.iw);
    free(run.w);
    return -1;
  }
  tf_start(&run, plant);
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
