// Reads correction.json (docs/exporting.md) without bodyschema: readings in, true joint angles and
// marker pose out. One header, C++17, no libraries. Reading angles allocates nothing.
#pragma once
#include <cmath>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

class Correction {
  std::vector<double> r;  // registers, then the program: steps of five whole numbers

  static bool whole(double number, double most) {
    return number >= 0 && number <= most && number == std::floor(number);
  }

  static void run(int step, double* to, const double* a, const double* b, const double* c) {
    const double turn = step > 5 && *c == 0 ? *b : 0, u = std::cos(turn), v = std::sin(turn);
    for (int k = 0; step < 2 && k < 1 + 2 * step; ++k) to[k] = a[k] + *c * b[k];
    if (step == 2) *to = *a + c[0] * std::sin(c[1] * *b + c[2]);
    if (step == 3 && !std::isnan(*a)) {  // a strain, its last reading, and how far it has begun
      const double move = to[2] > 0 ? *a - to[1] : 0, way = std::copysign(1, move);
      const double x = way * move / c[1], left = to[2] > 1 ? 1 - way * *to : 0;
      if (*c > 1) *to = *b < 0 ? 0 : move + std::copysign(std::pow(std::abs(c[1]), *b), c[1]) * *to;
      else if (move != 0) *to = way * (1 - (*c > 0 ? left * std::exp(-x) : std::fdim(left, x)));
      to[1] = *a;
      to[2] = move != 0 ? 2 : std::fmax(to[2], 1);
    }
    if (step == 4) *to = *c != 0 ? a[3] * b[2] : a[0] * b[1] - a[1] * b[0];
    if (step == 5) *to = std::abs(*a) > (*b != 0 ? *c : -1) ? (*a < 0 ? -1 : 1) : *b;
    if (step == 6) {  // what a body weighs, inwards
      const double x = u * a[0] - v * a[1], y = v * a[0] + u * a[1], z = a[2] + (*b - turn) * a[3];
      for (int k = 0; k < 3; ++k, c += 4) to[k] = c[1] * x + c[2] * y + c[3] * z + c[4] * a[3];
    }
    for (int row = 6; row < step; ++row, a += 4, to += 4) {  // rows of a pose, outwards
      for (int k = 0; k < 4; ++k) to[k] = c[k + 1] * a[0] + c[k + 5] * a[1] + c[k + 9] * a[2];
      const double x = to[0], y = to[1];
      to[0] = u * x + v * y;
      to[1] = u * y - v * x;
      to[3] += a[3] + (*b - turn) * to[2];
    }
  }

 public:
  explicit Correction(const std::string& file) {
    const size_t key = file.find("\"numbers\":"), format = file.find("\"bodyschema correction 3\"");
    std::istringstream text(key == file.npos ? "" : file.substr(key + 10));
    text.imbue(std::locale::classic());  // the decimal point, whatever locale the program has
    char mark = 0, due = '[';
    for (double x; text >> mark && mark == due && text >> x; due = ',') r.push_back(x);
    bool good = format != file.npos && mark == ']' && r.size() > 2 && whole(r[1], double(r.size()));
    good = good && whole(r[0], (r[1] - 28) / 2) && std::fmod(double(r.size()) - r[1], 5) == 0;
    // A step takes up to 13 registers in a row, and sets none of the first two.
    for (size_t k = good ? size_t(r[1]) : 0, n = 0; good && k < r.size(); ++k, ++n)
      good = whole(r[k], n % 5 > 0 ? r[1] - 13 : 9) && (n % 5 != 1 || r[k] > 1);
    if (!good) throw std::runtime_error("not a correction of version 3: use `bodyschema export`");
  }

  // Return the marker's pose in the measurement frame at the next readings, three rows of four, and
  // behind it the true joint angles. pace: time since the last readings, as a multiple of the usual
  // one; negative after an interruption. A reading that is not finite makes what depends on it NaN,
  // and is not remembered.
  const double* read(const std::vector<double>& q, double pace = 1.0) {
    const size_t d = size_t(r[0]);
    if (q.size() != d) throw std::invalid_argument("another number of readings than of joints");
    for (size_t k = 0; k < d; ++k) r[15 + d + k] = std::isfinite(q[k]) ? q[k] : NAN;
    r[2] = pace;
    for (const double *s = r.data() + size_t(r[1]), *end = r.data() + r.size(); s < end; s += 5)
      run(int(s[0]), &r[size_t(s[1])], &r[size_t(s[2])], &r[size_t(s[3])], &r[size_t(s[4])]);
    return &r[3];
  }
};
