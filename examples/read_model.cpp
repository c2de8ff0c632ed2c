// Reads a model file (docs/model_file.md) without bodyschema and prints its outputs: read_model FILE ANGLE...
// Build: g++ -std=c++17 -O2 read_model.cpp -o read_model. For machines whose numbers are little-endian, as nearly all.
// Angles in rad, in m for a joint that slides. Outputs: the marker's x, y, z [m], then e1, e2, e3 where there are any.
#include <cmath>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <map>
#include <stdexcept>
#include <vector>
using Error = std::runtime_error;
using Parameters = std::map<std::string, double>;
struct Model { std::vector<std::pair<std::string, Parameters>> bases; std::vector<double> net; };

Model read_model(const std::string& bytes) {
  if (bytes.size() < 32 || bytes.compare(0, 12, "KBMAP\r\n\0\1\0\0\0", 12)) throw Error("not a model file of version 1");
  unsigned length = 0;  // of 32 bits
  std::memcpy(&length, &bytes[12], sizeof length);
  const std::string header = bytes.substr(16, length);
  size_t count = 0;
  for (const char* at = header.c_str(); !count && (at = std::strstr(at, "\"outputs\""));) std::sscanf(at += 9, " : %zu", &count);
  Model model;
  for (const char* at = header.c_str(); (at = std::strstr(at, "\"kind\""));) {
    char kind[32], name[32];
    double value = 0;  // below, %n: the characters so far, if all before it is there; a blank: any number of them
    int read = 0;
    if (at += 6, std::sscanf(at, " : \"%31[a-z_]\" , \"parameters\" : %n", kind, &read), !read) continue;
    auto& [_, p] = model.bases.emplace_back(kind, Parameters());
    while (at += read, std::sscanf(at, " %*[{,] \"%31[a-z_]\" : %lf%n", name, &value, &read) == 2) p[name] = value;
    count *= std::strncmp(kind, "prismatic", 9) ? 3 : 2;
  }
  if (bytes.size() != 32 + size_t(length) + 8 * count) throw Error("the file is damaged or truncated");
  model.net.resize(count);
  std::memcpy(model.net.data(), &bytes[16 + length], 8 * count);
  return model;
}

std::vector<double> weights(const std::string& kind, const Parameters& p, double q) {
  if (kind == "trigonometric") return {1, std::cos(q), std::sin(q)};
  if (kind == "bernstein") {
    const double alpha = p.at("alpha"), half = (q - p.at("centre")) / 2;
    const double u = std::sin(half - alpha / 2) / std::sin(alpha), v = std::sin(half + alpha / 2) / std::sin(alpha);
    return {u * u, -2 * std::cos(alpha) * u * v, v * v};
  }
  const double low = p.at("low"), high = p.at("high"), share = (q - low) / (high - low);
  if (kind == "prismatic") return {1 - share, share};
  if (kind == "prismatic_orthonormal") return {1, std::sqrt(12) * p.at("scale") * (share - 0.5)};
  if (kind != "orthonormal") throw Error("unknown basis " + kind);
  const double t = q - (low + high) / 2, h = std::fmin((high - low) / 2, std::acos(-1.0)), scale = p.at("scale");
  const double mean = std::sin(h) / h, half = std::sin(2 * h) / (4 * h);
  const double cosine = (std::cos(t) - mean) / std::sqrt(0.5 + half - mean * mean);
  return {1, scale * cosine, scale * std::sin(t) / std::sqrt(0.5 - half)};
}

int main(int argc, char** argv) {
  std::ifstream file(argc > 1 ? argv[1] : "", std::ios::binary);
  auto [bases, values] = read_model({std::istreambuf_iterator<char>(file), {}});
  if (size_t(argc) != bases.size() + 2) throw Error("give " + std::to_string(bases.size()) + " angles");
  for (size_t k = bases.size(); k-- > 0;) {  // the last joint's index runs fastest
    const auto w = weights(bases[k].first, bases[k].second, std::stod(argv[2 + k]));
    std::vector<double> next(values.size() / w.size());
    for (size_t i = 0; i < values.size(); ++i) next[i / w.size()] += w[i % w.size()] * values[i];
    values = next;
  }
  for (double value : values) std::printf("%.17g\n", value);
}
