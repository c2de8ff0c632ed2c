// Reads correction.json (docs/exporting.md) without bodyschema: readings in, true joint angles and marker pose out.
// One header, C++17, no libraries. Reading angles allocates nothing.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

namespace correction {

struct Json {  // a value of a JSON file, or a table, or a list
  double number = 0;
  std::string text;
  std::vector<Json> list;
  std::map<std::string, Json> table;

  const Json& operator[](const char* key) const { return table.at(key); }
  template <size_t N> std::array<double, N> numbers() const {
    std::array<double, N> found{};
    for (size_t k = 0; k < std::min(N, list.size()); ++k) found[k] = list[k].number;
    return found;
  }
  static char next(const char*& at) { return *(at += std::strspn(at, " \t\r\n,:")); }
  static Json value(const char*& at) {
    Json found;
    if (next(at) == '"') {
      for (++at; *at && *at != '"'; ++at) found.text += *at == '\\' ? *++at : *at;
      if (!*at++) throw std::runtime_error("the file ends too soon");
    } else if (*at == '[') {
      for (++at; next(at) != ']';) found.list.push_back(value(at));
      ++at;
    } else if (*at == '{') {
      for (++at; next(at) != '}';) { std::string key = value(at).text; found.table[key] = value(at); }
      ++at;
    } else if (!std::strncmp(at, "true", 4)) { found.number = 1; at += 4;
    } else if (!std::strncmp(at, "false", 5)) { at += 5;
    } else {
      char* end;
      found.number = std::strtod(at, &end);
      if (end == at) throw std::runtime_error("not JSON, or it ends too soon");
      at = end;
    }
    return found;
  }
};

using Pose = std::array<double, 12>;  // three rows of four

inline Pose product(const Pose& P, const Pose& Q) {  // one pose after another
  Pose R;
  for (int r = 0; r < 12; r += 4)
    for (int c = 0; c < 4; ++c)
      R[r + c] = P[r] * Q[c] + P[r + 1] * Q[4 + c] + P[r + 2] * Q[8 + c] + (c == 3 ? P[r + 3] : 0.0);
  return R;
}

class Correction {
 public:
  std::vector<double> angles;  // true joint angles at the last readings
  Pose pose;                   // of the marker in the measurement frame

  explicit Correction(const std::string& text) {
    const char* at = text.c_str();
    const Json file = Json::value(at);
    if (file["format"].text != "bodyschema correction" || file["version"].number != 1)
      throw std::runtime_error("not a correction of version 1");
    static const char* kinds[] = {"joint_offset", "joint_scale", "joint_coupling", "joint_eccentricity",
                                  "joint_ripple", "backlash", "settling", "hysteresis", "gravity_backlash"};
    for (const Json& e : file["effects"].list) {
      const auto kind = std::find(std::begin(kinds), std::end(kinds), e["effect"].text);
      if (kind == std::end(kinds)) throw std::runtime_error("unknown effect " + e["effect"].text);
      const int source = e.table.count("source") ? int(e["source"].number) : 0;
      effects_.push_back({int(kind - kinds), int(e["joint"].number), source, e["values"].numbers<3>(),
                          e["state"].numbers<2>(), !e["state"].list.empty()});
      loose_ = loose_ || effects_.back().kind == kLoose;
    }
    for (const Json& j : file["joints"].list) {
      joints_.push_back({int(j["parent"].number), j["slides"].number != 0, j["pose"].numbers<12>(),
                         j["compliance"].number, j["mass_kg"].number, j["moment_kg_m"].numbers<3>(), 1, 0});
      springs_ = springs_ || joints_.back().compliance != 0;
    }
    for (const Json& k : file["outwards"].list) outwards_.push_back(int(k.number));
    const Pose unmoved{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
    frames_.assign(joints_.size() + 1, unmoved);  // the last is the root link's, which has the number -1 in the file
    sums_.resize(frames_.size());
    angles.resize(joints_.size());
    for (int end = 0; end < 2; ++end) {
      const Json& found = file[end ? "marker" : "camera"];
      ends_[end] = {above(int(found["parent"].number)), found["pose"].numbers<12>()};
    }
    gravity_ = file["gravity_m_s2"].number;
  }

  // Set `angles` and `pose` at the next readings. pace: time since the last ones, as a multiple of the usual one;
  // negative after an interruption.
  void read(const std::vector<double>& q, double pace = 1.0) {
    if (q.size() != joints_.size()) throw std::invalid_argument("another number of readings than of joints");
    angles = q;
    for (Effect& effect : effects_) angles[effect.joint] += error(effect, q, pace);
    for (size_t k = 0; k < joints_.size(); ++k) turn(k), sums_[k].unloaded = angles[k];
    place();
    for (int round = 0; springs_ && round < 3; ++round) {  // what gives moves its own load
      weigh();
      for (size_t k = 0; k < joints_.size(); ++k)
        if (joints_[k].compliance != 0) angles[k] = sums_[k].unloaded + joints_[k].compliance * sums_[k].torque, turn(k);
      place();
    }
    if (loose_) fall(), place();
    const Pose C = product(frames_[ends_[0].parent], ends_[0].pose);
    Pose back;
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) back[4 * r + c] = C[4 * c + r];
      back[4 * r + 3] = -(C[r] * C[3] + C[4 + r] * C[7] + C[8 + r] * C[11]);
    }
    pose = product(back, product(frames_[ends_[1].parent], ends_[1].pose));
  }

 private:
  struct Effect { int kind, joint, source; std::array<double, 3> values; std::array<double, 2> state; bool begun; };
  struct Joint {
    int parent;
    bool slides;
    Pose pose;
    double compliance, mass;
    std::array<double, 3> moment;
    double cosine = 1, sine = 0;  // of its angle
  };
  struct End { size_t parent; Pose pose; };
  struct Sum { double mass, x, y, torque, unloaded; };  // of what a joint carries: mass, mass times its place, its load

  static double error(Effect& e, const std::vector<double>& q, double pace) {  // added to the reading of its joint
    const double reading = q[e.joint], a = e.values[0], b = e.values[1], c = e.values[2];
    double &first = e.state[0], &second = e.state[1];
    switch (e.kind) {
      case 0: return a;
      case 1: return a * reading;
      case 2: return a * q[e.source];
      case 3: return std::asin(std::clamp(a * std::sin(reading) + b * std::cos(reading), -0.95, 0.95));
      case 4: return a * std::sin(c * reading) + b * std::cos(c * reading);
      case 5:  // the state: where the joint is, and whether it has ever moved
        if (!e.begun) e.state = {reading, 0.0};
        e.begun = true;
        if (second == 0.0 && reading != first) {  // it begins on the side to which its first move leads
          first -= std::copysign(a / 2, reading - first);
          second = 1.0;
        }
        if (second != 0.0) first = std::clamp(first, reading - a / 2, reading + a / 2);
        return first - reading;
      case 6:  // settling; the state: the last reading, and what was missing of it
        if (!e.begun) e.state = {reading, 0.0};
        e.begun = true;
        second = pace < 0 ? 0.0 : a * (reading - first) + second * std::pow(b, pace);
        first = reading;
        return -second;
      case 7: {  // hysteresis; the state: the last reading, and the strain from -1 to 1; 0 until it has moved
        if (!e.begun) e.state = {reading, 0.0};
        e.begun = true;
        const double kept = std::exp(-std::abs(reading - first) / b), way = reading < first ? -1 : 1;
        if (reading != first) second = second == 0.0 ? way : way * (1 - kept) + kept * second;
        first = reading;
        return -a * second;
      }
      default: return 0;  // a backlash under gravity follows the load, after the springs
    }
  }

  size_t above(int parent) const { return parent < 0 ? joints_.size() : size_t(parent); }

  void turn(size_t k) { joints_[k].cosine = std::cos(angles[k]), joints_[k].sine = std::sin(angles[k]); }

  void place() {  // all joints' frames in the root link's
    for (int k : outwards_) {
      Pose& F = frames_[k] = product(frames_[above(joints_[k].parent)], joints_[k].pose);
      const double u = joints_[k].cosine, v = joints_[k].sine;
      for (int r = 0; r < 12; r += 4) {
        const double a = F[r], b = F[r + 1];
        if (joints_[k].slides) F[r + 3] += angles[k] * F[r + 2];
        else F[r] = u * a + v * b, F[r + 1] = u * b - v * a;
      }
    }
  }

  void fall() {  // every joint with a backlash under gravity; the state: the side on which it rests
    weigh();
    for (Effect& e : effects_) {
      if (e.kind != kLoose) continue;
      const double torque = sums_[e.joint].torque;
      if (!e.begun || std::abs(torque) > e.values[1]) e.state[0] = torque < 0 ? -1 : 1;
      e.begun = true;
      angles[e.joint] += e.values[0] / 2 * e.state[0];
      turn(e.joint);
    }
  }

  void weigh() {  // gravity's torque about every joint, or force along it
    for (Sum& sum : sums_) sum.mass = sum.x = sum.y = 0.0;
    for (auto k = outwards_.rbegin(); k != outwards_.rend(); ++k) {
      const Joint& j = joints_[*k];
      const Pose& F = frames_[*k];
      Sum &own = sums_[*k], &parent = sums_[above(j.parent)];
      own.mass += j.mass;
      own.x += j.mass * F[3] + F[0] * j.moment[0] + F[1] * j.moment[1] + F[2] * j.moment[2];
      own.y += j.mass * F[7] + F[4] * j.moment[0] + F[5] * j.moment[1] + F[6] * j.moment[2];
      const double arm = F[6] * (own.x - own.mass * F[3]) - F[2] * (own.y - own.mass * F[7]);
      own.torque = gravity_ * (j.slides ? -own.mass * F[10] : arm);
      parent.mass += own.mass, parent.x += own.x, parent.y += own.y;
    }
  }

  std::vector<Effect> effects_;
  std::vector<Joint> joints_;
  std::vector<int> outwards_;
  std::vector<Pose> frames_;
  std::vector<Sum> sums_;
  End ends_[2];
  static constexpr int kLoose = 8;  // the kind of a backlash under gravity
  bool springs_ = false, loose_ = false;
  double gravity_;
};

}  // namespace correction
