/* Python's arithmetic, in C: the same bits for the same numbers.

   What Python would raise fails: the ticks are then flown in Python, which tells the error. Whole numbers beyond 2^61
   fail too, since Python's have no end. `turns` counts those of all loops: one that never ends fails. */

typedef long long whole, name; /* names of robots are their numbers */
typedef unsigned long long word; /* arithmetic modulo 2^64 */

double sin(double), cos(double), tan(double), asin(double), acos(double), atan(double), atan2(double, double);
double exp(double), expm1(double), log(double), log1p(double), tanh(double), pow(double, double), fmod(double, double);
double floor(double), ceil(double), trunc(double), rint(double), sqrt(double), fabs(double), copysign(double, double);
int snprintf(char *, unsigned long, const char *, ...);
double strtod(const char *, char **);
#ifndef __TINYC__ /* an instruction each, where a compiler knows them */
#define sqrt __builtin_sqrt
#define fabs __builtin_fabs
#define copysign __builtin_copysign
#endif

static word way[64]; /* back to the function that Python called, from any that it calls */
int _setjmp(void *) __attribute__((returns_twice));
void longjmp(void *, int) __attribute__((noreturn));
static void fail(void) __attribute__((noreturn, cold));
static void fail(void) { longjmp(way, 1); }

static whole turns;
static whole (*back)(whole, whole, double *); /* calls a rare function of an object in Python; 1: an error */
static const union { whole bits; double number; } unknown = {0x7ff8000000000000}; /* NaN */
static const double inf = 1e999, largest = 2305843009213693952.0; /* 2^61 */
static const whole exact = 9007199254740992; /* 2^53, up to which floats have every whole number */

/* whole numbers: a sum of two that fit is no more than 2^62 */
static inline whole py_fits(whole i) { if (i > (whole)largest || i < -(whole)largest) fail(); return i; }
static inline whole py_product(whole i, whole j) {
  if (fabs((double)i * (double)j) < largest) return i * j;
  fail();
}
static inline whole py_rest_i(whole i, whole j) { /* i % j: as j in sign */
  if (j == 0) fail();
  whole rest = i % j;
  return rest != 0 && (rest < 0) != (j < 0) ? rest + j : rest;
}
static inline whole py_floor_i(whole i, whole j) { /* i // j */
  if (j == 0) fail();
  return i / j - (i % j != 0 && (i < 0) != (j < 0));
}
static inline whole py_left(whole i, whole j) { return j < 0 || j > 60 ? (fail(), 0) : py_product(i, (whole)1 << j); }
static inline whole py_right(whole i, whole j) { return j < 0 ? (fail(), 0) : i >> (j > 62 ? 62 : j); }
static inline whole py_abs_i(whole i) { return i < 0 ? -i : i; }
static inline whole py_min_i(whole i, whole j) { return j < i ? j : i; }
static inline whole py_max_i(whole i, whole j) { return j > i ? j : i; }
static inline double py_exact(whole i) { if (i > exact || i < -exact) fail(); return (double)i; }
static inline double py_of_word(word x) { return x >> 63 ? 2.0 * (whole)(x >> 1 | (x & 1)) : (double)(whole)x; }
static inline whole py_int(double x) { if (fabs(x) < largest) return (whole)x; fail(); }

/* floats */
static inline double py_over(double x, double y) { if (y == 0.0) fail(); return x / y; }
static inline double py_rest(double x, double y) { /* x % y: as y in sign */
  if (y == 0.0) fail();
  double rest = fmod(x, y);
  return rest != 0.0 ? ((rest < 0.0) != (y < 0.0) ? rest + y : rest) : copysign(0.0, y);
}
static inline double py_floor_over(double x, double y) { /* x // y */
  if (y == 0.0) fail();
  double rest = fmod(x, y), found = (x - rest) / y;
  if (rest != 0.0 && (rest < 0.0) != (y < 0.0)) found -= 1.0;
  if (found == 0.0) return copysign(0.0, x / y);
  return floor(found) + (found - floor(found) > 0.5);
}
static inline double py_power(double x, double y) { /* x ** y; x * x is not always the same as pow(x, 2) */
  if ((x < 0.0 && fabs(x) < inf && fabs(floor(y) - y) > 0.0) || (x == 0.0 && y < 0.0 && y > -inf)) fail();
  double found = pow(x, y);
  if (fabs(found) == inf && fabs(x) < inf && fabs(y) < inf) fail();
  return found;
}
static inline double py_min(double x, double y) { return y < x ? y : x; }
static inline double py_max(double x, double y) { return y > x ? y : x; }
static inline double py_abs(double x) { return fabs(x); }
static inline whole py_round(double x) { return py_int(rint(x)); }
static inline whole py_turns(whole first, whole end, whole step) {
  return (step > 0) == (first < end) && first != end ? (end - first) / step + 1 : 0;
}
static inline double py_digits(double x, int digits) { /* float(f"{x:.7g}") */
  char text[64];
  snprintf(text, sizeof text, "%.*g", digits, x);
  return strtod(text, 0);
}
static double py_hypot(int n, const double *x) { /* as CPython's `vector_norm`: squares in two parts each, and a step */
  double most = 0.0, sum = 1.0, rest = 0.0, carry = 0.0, scale = 1.0, unit = 1.0;
  _Bool odd = 0;
  for (int k = 0; k < n; k++) {
    if (x[k] != x[k]) odd = 1;
    if (fabs(x[k]) > most) most = fabs(x[k]);
  }
  if (most == inf) return most;
  if (odd) return unknown.number;
  if (most == 0.0 || n <= 1) return most;
  if (most < 0x1p-1024) unit = 0x1p-1022;
  most /= unit;
  while (most * scale >= 1.0) scale *= 0.5;
  while (most * scale < 0.5) scale *= 2.0;
  for (int k = 0; k <= n; k++) {
    double root = k < n ? 0.0 : sqrt(sum - 1.0 + (rest + carry)), y = k < n ? x[k] / unit * scale : root;
    double up = y * 134217729.0, high = up - (up - y), low = y - high;
    double p = high * high, q = high * low + low * high, square = p + q, part = p - square + q + low * low, before = sum;
    if (k == n) square = -square, part = -part;
    sum += square;
    rest += part;
    carry += (before - sum) + square;
    if (k == n) return unit * ((root + (sum - 1.0 + (rest + carry)) / (2.0 * root)) / scale);
  }
  return 0.0;
}

/* memory of lists that a step makes */
static double room[1 << 15];
static whole rooms;
static inline void *py_room(whole bytes) {
  whole words = (bytes + 7) / 8;
  if (words < 0 || rooms + words > (whole)(sizeof room / 8)) fail();
  rooms += words;
  return room + rooms - words;
}

/* of `math`, where some numbers are an error */
#define OF_MATH(name, error) static inline double py_##name(double x) { if (error) fail(); return name(x); }
#define GROWS(name) static inline double py_##name(double x) { \
  double found = name(x); if (found == inf && x < inf) fail(); return found; }
OF_MATH(sqrt, x < 0.0) OF_MATH(log, x <= 0.0) OF_MATH(log1p, x <= -1.0) OF_MATH(sin, fabs(x) == inf) OF_MATH(cos, fabs(x) == inf)
OF_MATH(tan, fabs(x) == inf) OF_MATH(asin, fabs(x) > 1.0) OF_MATH(acos, fabs(x) > 1.0) GROWS(exp) GROWS(expm1)
OF_MATH(atan, 0) OF_MATH(tanh, 0) OF_MATH(fabs, 0)
static inline double py_atan2(double y, double x) { return atan2(y, x); }
static inline double py_copysign(double x, double y) { return copysign(x, y); }
static inline double py_degrees(double x) { return x * (180.0 / 3.141592653589793); }
static inline double py_radians(double x) { return x * (3.141592653589793 / 180.0); }
static inline whole py_floor(double x) { return py_int(floor(x)); }
static inline whole py_ceil(double x) { return py_int(ceil(x)); }
static inline whole py_trunc(double x) { return py_int(x); }
static inline _Bool py_isfinite(double x) { return fabs(x) < inf; }
static inline _Bool py_isinf(double x) { return fabs(x) == inf; }
static inline _Bool py_isnan(double x) { return x != x; }
