// Reads correction.json (docs/exporting.md) without bodyschema: readings in, true joint angles and marker pose out.
// One header, C++17, no libraries. Reading angles allocates nothing.
#pragma once
#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

class Correction {
  using Row = std::vector<double>;
  using Vector = std::array<double, 4>;

  // A table in the file, `width` numbers in a row (lists in it lose their brackets), the first indices below `limits`.
  std::vector<Row> rows(const std::string& key, size_t width, const Row& limits = {}) const {
    const size_t start = text.find('"' + key + "\":");
    if (text.find("\"bodyschema correction\"") == text.npos || start == text.npos ||
        (key != "version" && rows("version", 1) != std::vector<Row>(1, Row(1, 2.0))))
      throw std::runtime_error("not a correction of version 2: write it again with `bodyschema export`");
    std::vector<Row> found;
    bool good = true;
    const char *at = text.data() + start + key.size() + 3, *const stop = text.data() + text.size();
    for (int depth = 0; good && (depth > 0 || found.empty());) {
      double number = 0;
      const auto [end, error] = std::from_chars(at, stop, number);  // whatever the locale
      const char seen = *std::exchange(at, std::max(end, at + 1));
      if (error == std::errc() && std::isfinite(number)) (depth > 0 ? found : found = {Row()}).back().push_back(number);
      else if (seen == '[' && ++depth < 3 && (found.empty() || !found.back().empty())) found.emplace_back();
      else if (seen == ']' && depth > 0) --depth;
      else good = std::string_view(" \t\r\n,[").find(seen) != std::string_view::npos;
    }
    if (found == std::vector<Row>(1)) found.clear();
    for (const Row& row : found) good = good && row.size() == width;
    for (const Row& row : found)
      for (size_t k = 0; good && k < limits.size(); ++k)
        good = row[k] >= 0 && row[k] < limits[k] && row[k] == std::floor(row[k]);
    if (!good) throw std::runtime_error("a table is not as it should be: " + key);
    return found;
  }

  void give_way(bool loose, size_t inside) {  // let the springs yield to gravity, or all that is loose
    std::copy_n(gravity[0].begin(), 3, downs[0].begin());
    for (size_t k = 0; k < bodies.size(); ++k) {
      const double *body = bodies[k].data(), *P = body + 3, turn = body[2] != 0 ? 0 : angles[size_t(body[0])];
      const auto [p, q, r, _] = downs[size_t(body[1])];
      const double u = std::cos(turn), v = std::sin(turn), x = P[0] * p + P[4] * q + P[8] * r;
      const double y = P[1] * p + P[5] * q + P[9] * r, z = P[2] * p + P[6] * q + P[10] * r;
      downs[k + 1] = {u * x + v * y, u * y - v * x, z, _};
    }
    for (size_t k = bodies.size(); k > inside; --k) {
      double *body = bodies[k - 1].data(), *spring = body + 15, &angle = angles[size_t(body[0])];
      const auto [x, y, z, mass] = sums[k];
      const double torque = body[2] != 0 ? mass * downs[k][2] : x * downs[k][1] - y * downs[k][0];
      carry(k, size_t(body[1]), body[2] != 0, body + 3, angle);
      if (loose && std::abs(torque) > (spring[3] != 0 ? spring[2] : -1)) spring[3] = torque < 0 ? -1 : 1;  // its side
      angle = loose ? angle + spring[1] * spring[3] : free[size_t(body[0])] + spring[0] * torque;
    }
  }

  void carry(size_t body, size_t parent, bool slides, const double* P, double angle) {  // add its load to its parent's
    std::array<Vector, 1> load{sums[body]};
    through(P, slides, angle, load);
    for (size_t n = 0; n < 4; ++n) sums[parent][n] += load[0][n];
  }

  static double strain(double kind, double scale, double* state, double reading, double pace) {
    if (std::isnan(reading)) return reading;
    const double move = state[0] > 0 ? reading - state[1] : 0, way = move < 0 ? -1 : 1, x = way * move / scale;
    const double left = state[0] > 1 ? 1 - way * state[2] : 0;  // the first move shows the side
    if (kind > 1) state[2] = pace < 0 ? 0 : move + std::copysign(std::pow(std::abs(scale), pace), scale) * state[2];
    else if (move != 0) state[2] = way * (1 - (kind > 0 ? left * std::exp(-x) : std::max(left - x, 0.0)));
    state[0] = move != 0 ? 2 : std::max(state[0], 1.0), state[1] = reading;
    return state[2];
  }

  // Replace vectors (x, y, z, w) after a joint's motion by the same in the frame in which its own has the pose P.
  template <class Vectors> static void through(const double* P, bool slides, double angle, Vectors& vectors) {
    const double u = slides ? 1 : std::cos(angle), v = slides ? 0 : std::sin(angle), shift = slides ? angle : 0;
    for (Vector& vector : vectors) {
      const auto [p, q, r, w] = vector;
      const double x = u * p - v * q, y = v * p + u * q, z = r + shift * w;
      for (size_t n = 0; n < 3; ++n, P += 4) vector[n] = P[0] * x + P[1] * y + P[2] * z + P[3] * w;
      P -= 12;
    }
  }

  const std::string text;
  std::vector<Row> chain = rows("chain", 13), marker = rows("marker", 4), gravity = rows("gravity", 3),
      loads = rows("loads", 4);
  const size_t joints = chain.size(), links = loads.size();
  const double J = double(joints), L = double(links);
  std::vector<Row> zeros = rows("zeros", joints), ratios = rows("ratios", 3, {J, J}), waves = rows("waves", 4, {J}),
      memories = rows("memories", 7, {J}), carried = rows("carried", 16, {J, L, L}),
      bodies = rows("bodies", 19, {J, L}), passes = rows("passes", 2, {2, L});
  std::vector<Vector> downs{links, Vector{}}, sums{links, Vector{}}, own;
  Row free, q = Row(joints);

 public:
  std::vector<double> angles;   // true joint angles at the last readings
  std::array<double, 12> pose;  // of the marker in the measurement frame, three rows of four

  explicit Correction(const std::string& file) : text(file) {
    bool good = zeros.size() == 1 && gravity.size() == 1 && marker.size() == 4 && bodies.size() < links;
    for (size_t k = 0; good && k < bodies.size(); ++k) good = bodies[k][1] <= k;
    if (!good) throw std::runtime_error("the tables do not belong together");
  }

  // Set `angles` and `pose` at the next readings. pace: time since the last ones, as a multiple of the usual one;
  // negative after an interruption. A reading that is not finite makes what depends on it NaN, and is not remembered.
  void read(const std::vector<double>& readings, double pace = 1.0) {
    if (readings.size() != joints) throw std::invalid_argument("another number of readings than of joints");
    for (size_t k = 0; k < joints; ++k) q[k] = std::isfinite(readings[k]) ? readings[k] : NAN;
    angles = zeros[0];
    for (const Row& r : ratios) angles[size_t(r[0])] += r[2] * q[size_t(r[1])];
    for (const Row& r : waves) angles[size_t(r[0])] += r[1] * std::sin(r[2] * q[size_t(r[0])] + r[3]);
    for (Row& r : memories) angles[size_t(r[0])] -= r[2] * strain(r[1], r[3], &r[4], q[size_t(r[0])], pace);
    free = angles;
    for (size_t k = 0; k < loads.size(); ++k) std::copy_n(loads[k].begin(), 4, sums[k].begin());  // mass · place, mass
    for (const Row& r : carried) carry(size_t(r[1]), size_t(r[2]), r[3] != 0, &r[4], angles[size_t(r[0])]);
    own = sums;
    for (const Row& r : passes) sums = own, give_way(r[0] != 0, size_t(r[1]));  // what gives moves its own load
    std::array<Vector, 4> columns;
    for (size_t k = 0; k < 4; ++k) std::copy_n(marker[k].begin(), 4, columns[k].begin());
    for (size_t k = joints; k-- > 0;) through(&chain[k][1], chain[k][0] != 0, angles[k], columns);
    for (size_t k = 0; k < 12; ++k) pose[k] = columns[k % 4][k / 4];
  }
};
