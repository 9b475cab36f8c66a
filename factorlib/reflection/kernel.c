/* Values and gradients of a reflection network, 32 evaluations at a time.

   FORWARD and BACKWARD are written by factorlib/reflection/fused.py from the formulas in torch: FORWARD sets feature[f][l]
   and formula[l], BACKWARD the derivatives, given those of the result by each feature in slope[f][l].
   FEATURES, WIDTH and DEPTH are the network's; MOMENTS is the number of facts about a lobe.  Where no derivatives are asked
   for (out[1] is null), BACKWARD's are not computed: VALUE sets result[0] alone. */

#include <math.h>
#include <string.h>

/* The same bits on every machine: every operation is one of IEEE 754 that rounds to nearest, in the order written here.  The compiler
   may not reorder sums, contract products or replace divisions (see FLAGS in fused.py), and spreads lanes alone over vectors. */
#define FMA __builtin_fmaf /* a b + c, rounded once */

#define LANES 32
typedef float lanes[LANES];

static inline float min_(float a, float b) { return a < b ? a : b; }
static inline float max_(float a, float b) { return a > b ? a : b; }

static inline float exp_(float x) {  /* within 2e-7 */
  x = min_(max_(x, -80.0f), 80.0f);
  int n = (int)FMA(x, 1.44269504f, x < 0.0f ? -0.5f : 0.5f);
  float f = FMA(-(float)n, 1.42860677e-6f, FMA(-(float)n, 0.693145752f, x));
  float p = FMA(f, 1.38888889e-3f, 8.33333333e-3f);
  p = FMA(f, p, 4.16666667e-2f), p = FMA(f, p, 1.66666667e-1f), p = FMA(f, p, 0.5f), p = FMA(f, p, 1.0f), p = FMA(f, p, 1.0f);
  int bits = (n + 127) << 23;
  float scale;
  memcpy(&scale, &bits, 4);
  return p * scale;
}

static inline float log_(float x) {  /* of normal positive numbers */
  int bits;
  memcpy(&bits, &x, 4);
  int e = ((bits - 0x3f3504f3) >> 23);
  bits -= e << 23;
  float m;
  memcpy(&m, &bits, 4);  /* in [√½, √2) */
  float s = (m - 1.0f) / (m + 1.0f), q = s * s, p = FMA(q, 1.11111111e-1f, 1.42857143e-1f);
  p = FMA(q, p, 0.2f), p = FMA(q, p, 3.33333333e-1f), p = FMA(q, p, 1.0f);
  return FMA((float)e, 0.693147181f, 2.0f * s * p);
}

static inline float log1p_(float x) {  /* of what is not negative */
  float s = x / (2.0f + x), q = s * s;
  float near = 2.0f * s * FMA(q, FMA(q, FMA(q, 1.42857143e-1f, 0.2f), 3.33333333e-1f), 1.0f);
  return x < 0.3f ? near : log_(1.0f + x);
}

static inline float erfc_(float x) {  /* within 2e-7; Abramowitz and Stegun 1964, 7.1.26 */
  float y = fabsf(x), t = 1.0f / (1.0f + 0.3275911f * y);
  float p = FMA(t, FMA(t, FMA(t, FMA(t, 1.061405429f, -1.453152027f), 1.421413741f), -0.284496736f), 0.254829592f);
  float tail = t * p * exp_(-y * y);
  return x < 0.0f ? 2.0f - tail : tail;
}

/* out[j] = bias[j] + Σ_i w[j][i] in[i] */
static inline void linear(int outs, int ins, const float *restrict w, const float *restrict bias, lanes *restrict in, lanes *restrict out) {
  for (int j = 0; j < outs; j += 4) {
    lanes a, b, c, d;
    for (int l = 0; l < LANES; l++) a[l] = bias[j], b[l] = bias[j + 1], c[l] = bias[j + 2], d[l] = bias[j + 3];
    for (int i = 0; i < ins; i++) {
      const float wa = w[j * ins + i], wb = w[(j + 1) * ins + i], wc = w[(j + 2) * ins + i], wd = w[(j + 3) * ins + i];
      for (int l = 0; l < LANES; l++) {
        a[l] = FMA(wa, in[i][l], a[l]), b[l] = FMA(wb, in[i][l], b[l]);
        c[l] = FMA(wc, in[i][l], c[l]), d[l] = FMA(wd, in[i][l], d[l]);
      }
    }
    memcpy(out[j], a, sizeof a), memcpy(out[j + 1], b, sizeof b), memcpy(out[j + 2], c, sizeof c), memcpy(out[j + 3], d, sizeof d);
  }
}

/* Replaces x by SiLU(x), and says its derivative. */
static inline void silu(int count, lanes *restrict x, lanes *restrict derivative) {
  for (int j = 0; j < count; j++)
    for (int l = 0; l < LANES; l++) {
      float s = 1.0f / (1.0f + exp_(-x[j][l]));
      derivative[j][l] = s * (1.0f + x[j][l] * (1.0f - s));
      x[j][l] *= s;
    }
}

/* The network and, unless `slope` is null, its derivative by each feature.  w: for each layer its weights [out, in], then, for all layers but the
   last, the transposed ones [in, out] in the same order; features are standardised within the first. */
static inline void network(const float *w, const float *b, const float *wt, lanes *feature, float *result, lanes *slope) {
  static const float zero[WIDTH > FEATURES ? WIDTH : FEATURES];
  lanes x[2][WIDTH], derivative[DEPTH][WIDTH];
  int ins = FEATURES;
  for (int k = 0; k < DEPTH; k++) {
    linear(WIDTH, ins, w, b, k ? x[(k + 1) % 2] : feature, x[k % 2]);
    silu(WIDTH, x[k % 2], derivative[k]);
    w += WIDTH * ins, b += WIDTH, ins = WIDTH;
  }
  lanes *last = x[(DEPTH + 1) % 2], *back = x[DEPTH % 2];
  for (int l = 0; l < LANES; l++) result[l] = b[0];
  for (int j = 0; j < WIDTH; j++)
    for (int l = 0; l < LANES; l++) result[l] = FMA(w[j], last[j][l], result[l]), back[j][l] = w[j];
  if (!slope) return;
  for (int k = DEPTH - 1; k >= 0; k--) {
    for (int j = 0; j < WIDTH; j++)
      for (int l = 0; l < LANES; l++) back[j][l] *= derivative[k][j][l];
    lanes *next = k ? (back == x[0] ? x[1] : x[0]) : slope;
    linear(k ? WIDTH : FEATURES, WIDTH, wt + (k ? FEATURES * WIDTH + (k - 1) * WIDTH * WIDTH : 0), zero, back, next);
    back = next;
  }
}

/* lobes: λ, λ', t̄, v∥, v⊥ and the derivatives of all five by log λ, each [p]; out: value and its derivatives by α, log λ,
   n·o, n·z and o·z, each [rows, p]. */
void response(long rows, long p, float alpha, const float *lobes, const float *no_, const float *nz_, const float *oz_,
              const float *w, const float *b, const float *wt, float *const *out) {
  long size = rows * p;
  for (long start = 0; start < size; start += LANES) {
    lanes no, nz, oz, lobe[2 * MOMENTS], formula, net, feature[FEATURES], slope[FEATURES], result[6];
    long row = start / p, column = start % p;
    for (int l = 0; l < LANES; l++) {
      long at = start + l < size ? start + l : size - 1;
      no[l] = no_[row], nz[l] = nz_[at], oz[l] = oz_[at];
      for (int k = 0; k < 2 * MOMENTS; k++) lobe[k][l] = lobes[k * p + column];
      if (start + l + 1 < size && ++column == p) column = 0, row++;
    }
    for (int l = 0; l < LANES; l++) {
      FORWARD
    }
    network(w, b, wt, feature, net, out[1] ? slope : 0);
    if (out[1])
      for (int l = 0; l < LANES; l++) {
        BACKWARD
      }
    else
      for (int l = 0; l < LANES; l++) {
        VALUE
      }
    long count = size - start < LANES ? size - start : LANES;
    for (int k = 0; k < (out[1] ? 6 : 1); k++) memcpy(out[k] + start, result[k], count * sizeof(float));
  }
}
