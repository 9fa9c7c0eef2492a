/* Derivatives of a run along directions, beside driver.c: tangents S of the states follow dS/dt = f_x S + f_theta D
 * by the same RK4 steps. TF_DIRECTIONS directions lie in a vector `tf_wide`; a run carries up to TF_BLOCKS of them.
 */
#define TF_BLOCKS 4

/* The states whose tangents are read within a step; the others are integrals beside the model. */
static const int tf_read[TF_READS] = TF_READ_STATES;

/* What one block of directions changes, and the tangents of the ground. */
typedef struct {
  const double *table; /* (knots, TF_NP, TF_DIRECTIONS) */
  tf_wide vehicle[TF_NV], effects[TF_NE + 1], soil[TF_NP * TF_WHEELS], held[TF_KEPT_HELD_WIDE];
  tf_wide log_gain[TF_WHEELS], share[TF_WHEELS];
} tf_block;

typedef struct {
  tf_runs runs;
  long count; /* of blocks */
  tf_block blocks[TF_BLOCKS];
} tf_tangents;

static tf_wide tf_wide_at(const double *values, long i) {
  tf_wide r;
  memcpy(&r, values + i * TF_DIRECTIONS, sizeof r);
  return r;
}

/* Value of a periodic grid along a direction, from its gradient within the cell. */
static tf_wide tf_grid_wide(const tf_plant *plant, const double *grid, double column, double row, tf_wide dc, tf_wide dr) {
  const double c = floor(column), r = floor(row), fc = column - c, fr = row - r;
  const double g00 = tf_grid(plant, grid, c, r), g01 = tf_grid(plant, grid, c + 1.0, r);
  const double g10 = tf_grid(plant, grid, c, r + 1.0), g11 = tf_grid(plant, grid, c + 1.0, r + 1.0);
  const double by_column = (1.0 - fr) * (g01 - g00) + fr * (g11 - g10);
  const double by_row = (1.0 - fc) * (g10 - g00) + fc * (g11 - g01);
  return by_column * dc + by_row * dr;
}

static void tf_field_wide(const tf_ground *ground, tf_block *block, const double *x, const tf_wide *s) {
  const tf_plant *plant = ground->plant;
  const double cosine = cos(x[TF_YAW]), sine = sin(x[TF_YAW]), cells = 1.0 / plant->cell;
  for (int k = 0; k < TF_WHEELS; ++k) {
    const double ahead = ground->ahead[k], left = ground->left[k];
    const tf_wide d_ahead = ahead / plant->vehicle[TF_WHEELBASE] * block->vehicle[TF_WHEELBASE];
    const tf_wide d_left = left / plant->vehicle[TF_TRACK] * block->vehicle[TF_TRACK];
    const double east = cosine * ahead - sine * left, north = sine * ahead + cosine * left;
    const tf_wide dx = (s[TF_X] - north * s[TF_YAW] + cosine * d_ahead - sine * d_left) * cells;
    const tf_wide dy = (s[TF_Y] + east * s[TF_YAW] + sine * d_ahead + cosine * d_left) * cells;
    const double column = (x[TF_X] + east) * cells, row = (x[TF_Y] + north) * cells;
    block->log_gain[k] = tf_grid_wide(plant, plant->log_gain, column, row, dx, dy);
    block->share[k] = tf_grid_wide(plant, plant->patch_share, column, row, dx, dy);
  }
}

/* Tangents of the soil under each wheel. */
static void tf_soil_wide(const tf_ground *ground, tf_block *block, double t, double travel, tf_wide d_travel) {
  const tf_plant *plant = ground->plant;
  for (int k = 0; k < TF_WHEELS; ++k) {
    const tf_place place = tf_where(ground, k, t, travel);
    const long next = place.row < plant->knots - 1 ? place.row + 1 : place.row;
    const double *a = plant->table + place.row * TF_NP, *b = plant->table + next * TF_NP;
    const tf_wide d_ahead = ground->ahead[k] / plant->vehicle[TF_WHEELBASE] * block->vehicle[TF_WHEELBASE];
    const tf_wide d_weight = place.slope * plant->travel_weight * (d_travel + d_ahead);
    for (int i = 0; i < TF_NP; ++i) {
      const tf_wide da = tf_wide_at(block->table, place.row * TF_NP + i), db = tf_wide_at(block->table, next * TF_NP + i);
      tf_wide d = da + place.weight * (db - da) + (b[i] - a[i]) * d_weight;
      if (plant->rows > 0) {
        const double gain = ground->gain[k][i], value = gain * (a[i] + place.weight * (b[i] - a[i]));
        d = gain * d + value * plant->response[i] * block->log_gain[k];
        d = (1.0 - ground->share[k]) * d + (plant->patch_soil[i] - value) * block->share[k];
      }
      block->soil[i * TF_WHEELS + k] = d;
    }
  }
}

static void tf_tangents_start(tf_tangents *all, double t, const double *x, tf_wide s[TF_BLOCKS][TF_NX]) {
  tf_runs *runs = &all->runs;
  for (long b = 0; b < all->count; ++b) {
    tf_block *block = &all->blocks[b];
    if (runs->ground[0].plant->rows > 0) tf_field_wide(&runs->ground[0], block, x, s[b]);
    tf_soil_wide(&runs->ground[0], block, t, x[TF_TRAVEL], s[b][TF_TRAVEL]);
    tf_once_wide(runs->vehicle, runs->effects, runs->soil, runs->held, block->vehicle, block->effects, block->soil,
                 block->held);
  }
}

/* After tf_slope at the same x: the block's slope. */
static void tf_slope_wide(tf_runs *runs, tf_block *block, double t, const double *x, const double *u, const tf_wide *s,
                          tf_wide *ds) {
  if (runs->changing) tf_soil_wide(&runs->ground[0], block, t, x[TF_TRAVEL], s[TF_TRAVEL]);
  tf_each_wide(x, u, runs->vehicle, runs->effects, runs->soil, runs->held, runs->local, s, block->vehicle,
               block->effects, block->soil, block->held, ds);
}

static void tf_rk4_wide(tf_tangents *all, double t, double h, double *x, tf_wide s[TF_BLOCKS][TF_NX],
                        double u[3][TF_NU]) {
  tf_runs *runs = &all->runs;
  double k[4][TF_NX], y[TF_NX];
  tf_wide ks[4][TF_BLOCKS][TF_NX], ys[TF_NX];
  if (runs->ground[0].plant->rows > 0) {
    tf_fields(runs, x);
    for (long b = 0; b < all->count; ++b) tf_field_wide(&runs->ground[0], &all->blocks[b], x, s[b]);
  }
  for (int stage = 0; stage < 4; ++stage) {
    const double ahead = tf_stage_at[stage] * h, *at = stage ? y : x, *input = u[tf_stage_input[stage]];
    if (stage)
      for (int i = 0; i < TF_NX; ++i) y[i] = x[i] + ahead * k[stage - 1][i];
    tf_slope(runs, t + ahead, at, input, k[stage]);
    for (long b = 0; b < all->count; ++b) {
      if (stage)
        for (int r = 0; r < TF_READS; ++r) {
          const int i = tf_read[r];
          ys[i] = s[b][i] + ahead * ks[stage - 1][b][i];
        }
      tf_slope_wide(runs, &all->blocks[b], t + ahead, at, input, stage ? ys : s[b], ks[stage][b]);
    }
  }
  for (int i = 0; i < TF_NX; ++i) x[i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
  for (long b = 0; b < all->count; ++b)
    for (int i = 0; i < TF_NX; ++i)
      s[b][i] += h / 6.0 * (ks[0][b][i] + 2.0 * ks[1][b][i] + 2.0 * ks[2][b][i] + ks[3][b][i]);
}

/* One sample: the states into out (TF_NX), the tangents into out_wide (TF_NX, blocks, TF_DIRECTIONS). */
static void tf_write_wide(const double *x, tf_wide s[TF_BLOCKS][TF_NX], long blocks, double *out, double *out_wide) {
  memcpy(out, x, sizeof(double) * TF_NX);
  for (int c = 0; c < TF_NX; ++c)
    for (long b = 0; b < blocks; ++b)
      memcpy(out_wide + (c * blocks + b) * TF_DIRECTIONS, &s[b][c], sizeof(tf_wide));
}

/* As tf_simulate of one run, with `blocks` (at most TF_BLOCKS) blocks of directions: start (blocks, TF_NX,
 * TF_DIRECTIONS), vehicle (blocks, TF_NV, ...), effects (blocks, TF_NE, ...), table (blocks, knots TF_NP, ...). */
TF_EXPORT void tf_simulate_wide(const tf_plant *plant, long n, long substeps, long every, double t0, double dt,
                                const double *inputs, double *out, long blocks, const double *start,
                                const double *vehicle, const double *effects, const double *table, double *out_wide) {
  tf_tangents all;
  tf_wide s[TF_BLOCKS][TF_NX];
  double x[TF_NX], u[3][TF_NU];
  const double h = dt / (double)substeps;
  memcpy(x, out, sizeof x);
  all.count = blocks;
  for (long b = 0; b < blocks; ++b) {
    all.blocks[b].table = table + b * plant->knots * TF_NP * TF_DIRECTIONS;
    for (long c = 0; c < TF_NX; ++c) s[b][c] = tf_wide_at(start, b * TF_NX + c);
    for (long c = 0; c < TF_NV; ++c) all.blocks[b].vehicle[c] = tf_wide_at(vehicle, b * TF_NV + c);
    for (long c = 0; c < TF_NE; ++c) all.blocks[b].effects[c] = tf_wide_at(effects, b * TF_NE + c);
  }
  tf_runs_start(&all.runs, &plant, t0, x);
  tf_tangents_start(&all, t0, x, s);
  tf_write_wide(x, s, blocks, out, out_wide);
  for (long i = 0; i < n; ++i) {
    for (long j = 0; j < substeps; ++j) {
      tf_inputs(&inputs, i, j, substeps, u);
      tf_rk4_wide(&all, t0 + (double)i * dt + (double)j * h, h, x, s, u);
    }
    const long row = (i + 1) / every;
    if ((i + 1) % every == 0)
      tf_write_wide(x, s, blocks, out + row * TF_NX, out_wide + row * TF_NX * blocks * TF_DIRECTIONS);
  }
}
