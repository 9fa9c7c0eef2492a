/* Fixed-step Runge-Kutta around the generated right-hand side, for TF_RUNS runs at a time.
 *
 * Inputs are linear between samples. Each wheel has its own soil: at the coordinate
 * c = time_weight * t + travel_weight * (travel + its distance ahead of the body origin) the
 * parameters are joined smoothly (3 w^2 - 2 w^3) between the knots of the route table, then
 * varied by the field of the plane, whose value is taken at the start of a step.
 *
 * Ahead of this file stand the sizes and indices from layout.py (TF_NX states, TF_NU inputs, TF_NV vehicle
 * and TF_NP soil parameters, TF_NE effects), the types and the generated functions tf_once and tf_each.
 */
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

/* The ground under the wheels of one run. */
typedef struct {
  const tf_plant *plant;
  double ahead[TF_WHEELS], left[TF_WHEELS]; /* hubs from the body origin */
  long row[TF_WHEELS];                      /* row of the table that `soil` holds as it is, -1 where it is mixed */
  double gain[TF_WHEELS][TF_NP], share[TF_WHEELS];
} tf_ground;

static void tf_ground_start(tf_ground *ground, const tf_plant *plant) {
  static const double sx[TF_WHEELS] = {0.5, 0.5, -0.5, -0.5}, sy[TF_WHEELS] = {0.5, -0.5, 0.5, -0.5};
  ground->plant = plant;
  for (int k = 0; k < TF_WHEELS; ++k) {
    ground->ahead[k] = sx[k] * plant->vehicle[TF_WHEELBASE];
    ground->left[k] = sy[k] * plant->vehicle[TF_TRACK];
    ground->row[k] = -1;
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

static void tf_field(tf_ground *ground, double x, double y, double yaw) {
  const tf_plant *plant = ground->plant;
  if (!isfinite(x + y + yaw)) return; /* a run that has diverged */
  const double cosine = cos(yaw), sine = sin(yaw);
  for (int k = 0; k < TF_WHEELS; ++k) {
    const double px = (x + cosine * ground->ahead[k] - sine * ground->left[k]) / plant->cell;
    const double py = (y + sine * ground->ahead[k] + cosine * ground->left[k]) / plant->cell;
    const double g = tf_grid(plant, plant->log_gain, px, py);
    ground->share[k] = tf_grid(plant, plant->patch_share, px, py);
    for (int i = 0; i < TF_NP; ++i) ground->gain[k][i] = plant->response[i] == 0.0 ? 1.0 : exp(plant->response[i] * g);
  }
}

/* Where a wheel is on the route: row of the table, weight of the row after it, and its derivative. */
typedef struct {
  long row;
  double weight, slope;
} tf_place;

static tf_place tf_where(const tf_ground *ground, int wheel, double t, double travel) {
  const tf_plant *plant = ground->plant;
  const double c = plant->time_weight * t + plant->travel_weight * (travel + ground->ahead[wheel]);
  tf_place place = {0, 0.0, 0.0};
  while (place.row < plant->knots - 1 && c >= plant->at[place.row + 1]) ++place.row;
  if (place.row < plant->knots - 1 && c > plant->at[0]) {
    const double length = plant->at[place.row + 1] - plant->at[place.row], s = (c - plant->at[place.row]) / length;
    place.weight = s * s * (3.0 - 2.0 * s);
    place.slope = 6.0 * s * (1.0 - s) / length;
  }
  return place;
}

/* The soil under each wheel into soil[(parameter * TF_WHEELS + wheel) * stride]. */
static void tf_soil(tf_ground *ground, double t, double travel, tf_number *soil, int stride) {
  const tf_plant *plant = ground->plant;
  for (int k = 0; k < TF_WHEELS; ++k) {
    const tf_place place = tf_where(ground, k, t, travel);
    const double *a = plant->table + place.row * TF_NP, *b = place.weight == 0.0 ? a : a + TF_NP;
    const int whole = plant->rows == 0 && place.weight == 0.0;
    if (whole && ground->row[k] == place.row) continue;
    ground->row[k] = whole ? place.row : -1;
    for (int i = 0; i < TF_NP; ++i) {
      double value = a[i] + place.weight * (b[i] - a[i]);
      if (plant->rows > 0) {
        value *= ground->gain[k][i];
        value += ground->share[k] * (plant->patch_soil[i] - value);
      }
      soil[(i * TF_WHEELS + k) * stride] = (tf_number)value;
    }
  }
}

/* TF_RUNS runs side by side: lane i of every tf_real belongs to run i. */
typedef struct {
  tf_ground ground[TF_RUNS];
  int changing; /* whether the soil changes on the way */
  tf_real vehicle[TF_NV], effects[TF_NE + 1], soil[TF_NP * TF_WHEELS], held[TF_KEPT_HELD], local[TF_KEPT_LOCAL];
  tf_real over[TF_NX]; /* by how much the states, as they are held, are too large (numbers of 32 bits) */
} tf_runs;

#define TF_LANE(values, lane) ((tf_number *)(values) + (lane))

static void tf_soils(tf_runs *runs, double t, const tf_real *x) {
  for (int i = 0; i < TF_RUNS; ++i)
    tf_soil(&runs->ground[i], t, *TF_LANE(x + TF_TRAVEL, i), TF_LANE(runs->soil, i), TF_RUNS);
}

static void tf_fields(tf_runs *runs, const tf_real *x) {
  for (int i = 0; i < TF_RUNS; ++i)
    if (runs->ground[i].plant->rows > 0)
      tf_field(&runs->ground[i], *TF_LANE(x + TF_X, i), *TF_LANE(x + TF_Y, i), *TF_LANE(x + TF_YAW, i));
}

static void tf_runs_start(tf_runs *runs, const tf_plant *const *plants, double t, const tf_real *x) {
  runs->changing = 0;
  for (int i = 0; i < TF_RUNS; ++i) {
    tf_ground_start(&runs->ground[i], plants[i]);
    runs->changing |= plants[i]->knots > 1 || plants[i]->rows > 0;
    for (int k = 0; k < TF_NV; ++k) *TF_LANE(runs->vehicle + k, i) = (tf_number)plants[i]->vehicle[k];
    for (int k = 0; k < TF_NE; ++k) *TF_LANE(runs->effects + k, i) = (tf_number)plants[i]->effects[k];
  }
  tf_fields(runs, x);
  tf_soils(runs, t, x);
  tf_once(runs->vehicle, runs->effects, runs->soil, runs->held);
}

static void tf_slope(tf_runs *runs, double t, const tf_real *x, const tf_real *u, tf_real *dx) {
  if (runs->changing) tf_soils(runs, t, x);
  tf_each(x, u, runs->vehicle, runs->effects, runs->soil, runs->held, runs->local, dx);
}

/* Where the stages of a step lie ahead of its start, and which input they take: RK4, and RK3 with three of them. */
static const double tf_stage_at[4] = {0.0, 0.5, 0.5, 1.0}, tf_third_at[3] = {0.0, 0.5, 1.0};
static const int tf_stage_input[4] = {0, 1, 1, 2}, tf_third_input[3] = {0, 1, 2};

/* What a step adds to a state. In 32 bits thousands of small steps would round the same way: what is lost is
 * kept and added with the next (Kahan 1965, Further remarks on reducing truncation errors). */
static inline void tf_add(tf_runs *runs, tf_real *x, int i, tf_real step) {
#if defined(TF_32)
  const tf_real more = step - runs->over[i], sum = x[i] + more;
  runs->over[i] = (sum - x[i]) - more;
  x[i] = sum;
#else
  (void)runs;
  x[i] += step;
#endif
}

/* A step of the classical method of fourth order, or of Kutta's of third (1901). */
static void tf_step(tf_runs *runs, double t, tf_number h, long order, tf_real *x, tf_real u[3][TF_NU]) {
  tf_real k[4][TF_NX], y[TF_NX];
  const double *at = order == 3 ? tf_third_at : tf_stage_at;
  const tf_number two = 2, four = 4, sixth = h / 6;
  const int *input = order == 3 ? tf_third_input : tf_stage_input;
  if (runs->changing) tf_fields(runs, x);
  for (int stage = 0; stage < order; ++stage) {
    const tf_number ahead = (tf_number)at[stage] * h;
    if (stage == 2 && order == 3)
      for (int i = 0; i < TF_NX; ++i) y[i] = x[i] + h * (two * k[1][i] - k[0][i]);
    else if (stage)
      for (int i = 0; i < TF_NX; ++i) y[i] = x[i] + ahead * k[stage - 1][i];
    tf_slope(runs, t + ahead, stage ? y : x, u[input[stage]], k[stage]);
  }
  if (order == 3)
    for (int i = 0; i < TF_NX; ++i) tf_add(runs, x, i, sixth * (k[0][i] + four * k[1][i] + k[2][i]));
  else
    for (int i = 0; i < TF_NX; ++i) tf_add(runs, x, i, sixth * (k[0][i] + two * k[1][i] + two * k[2][i] + k[3][i]));
}

/* Inputs at the start, middle and end of step j of `substeps` after a sample. */
static void tf_inputs(const double *const *inputs, long sample, long j, long substeps, tf_real u[3][TF_NU]) {
  for (int i = 0; i < TF_RUNS; ++i) {
    const double *a = inputs[i] + sample * TF_NU, *b = a + TF_NU;
    for (int m = 0; m < 3; ++m) {
      const double f = ((double)j + 0.5 * m) / (double)substeps;
      for (int c = 0; c < TF_NU; ++c) *TF_LANE(u[m] + c, i) = (tf_number)(a[c] + f * (b[c] - a[c]));
    }
  }
}

#if defined(_WIN32)
#define TF_EXPORT __declspec(dllexport)
#else
#define TF_EXPORT __attribute__((visibility("default")))
#endif

/* Numbers of 32 bits that die away become subnormal soon, which many processors handle slowly: zero instead. */
#if defined(TF_32) && defined(__SSE__)
#include <immintrin.h>
#define TF_WITHOUT_SUBNORMALS const unsigned tf_mode = _mm_getcsr(); _mm_setcsr(tf_mode | 0x8040);
#define TF_AS_BEFORE _mm_setcsr(tf_mode);
#else
#define TF_WITHOUT_SUBNORMALS
#define TF_AS_BEFORE
#endif

#if defined(TF_DIRECTIONS)
TF_EXPORT const int tf_lanes = TF_DIRECTIONS;
#else
TF_EXPORT const int tf_lanes = TF_RUNS;
#endif

/* A state (TF_NX) of run k into the lanes, and out of them with what they lack. */
static void tf_take(tf_runs *runs, tf_real *x, int k, const double *from) {
  for (int c = 0; c < TF_NX; ++c) {
    *TF_LANE(x + c, k) = (tf_number)from[c];
    *TF_LANE(runs->over + c, k) = (tf_number)((double)*TF_LANE(x + c, k) - from[c]);
  }
}

static void tf_give(const tf_runs *runs, const tf_real *x, int k, double *to) {
  for (int c = 0; c < TF_NX; ++c) to[c] = *TF_LANE(x + c, k);
#if defined(TF_32)
  for (int c = 0; c < TF_NX; ++c) to[c] -= *TF_LANE(runs->over + c, k);
#else
  (void)runs;
#endif
}

/* The states of all runs as if they had been given and taken: a run that is stopped at a sample and goes on from
 * there has the bits of one that is not. */
static void tf_through(tf_runs *runs, tf_real *x) {
#if defined(TF_32)
  for (int c = 0; c < TF_NX; ++c) {
    const tf_double whole = TF_AS_DOUBLE(x[c]) - TF_AS_DOUBLE(runs->over[c]);
    x[c] = TF_AS_NUMBER(whole);
    runs->over[c] = TF_AS_NUMBER(TF_AS_DOUBLE(x[c]) - whole);
  }
#else
  (void)runs, (void)x;
#endif
}

/* Samples x(t0 + i dt), i = 0..n, of TF_RUNS runs; every `every`-th into outs[run] ((n / every + 1, TF_NX)),
 * whose first row holds x(t0) on entry, by Runge-Kutta steps of `order` 4 or 3. Two lanes may name the same run. */
TF_EXPORT void tf_simulate(const tf_plant *const *plants, long n, long substeps, long order, long every, double t0,
                           double dt, const double *const *inputs, double *const *outs) {
  tf_runs runs;
  tf_real x[TF_NX], u[3][TF_NU];
  const double h = dt / (double)substeps;
  TF_WITHOUT_SUBNORMALS
  for (int k = 0; k < TF_RUNS; ++k) tf_take(&runs, x, k, outs[k]);
  tf_runs_start(&runs, plants, t0, x);
  for (long i = 0; i < n; ++i) {
    for (long j = 0; j < substeps; ++j) {
      tf_inputs(inputs, i, j, substeps, u);
      tf_step(&runs, t0 + (double)i * dt + (double)j * h, (tf_number)h, order, x, u);
    }
    tf_through(&runs, x);
    if ((i + 1) % every == 0)
      for (int k = 0; k < TF_RUNS; ++k) tf_give(&runs, x, k, outs[k] + (i + 1) / every * TF_NX);
  }
  TF_AS_BEFORE
}
