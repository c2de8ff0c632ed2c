// correct correction.json < readings.txt    readings in each line; prints the true joint angles, then the marker's pose
// Build: g++ -std=c++17 -O2 correct.cpp -o correct
#include "correction.hpp"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <iterator>
#include <sstream>

int main(int argc, char** argv) {
  std::ifstream file(argc > 1 ? argv[1] : "", std::ios::binary);
  Correction arm(std::string(std::istreambuf_iterator<char>(file), {}));
  for (std::string line; std::getline(std::cin, line);) {
    std::replace(line.begin(), line.end(), ',', ' ');
    std::istringstream words(line);
    std::vector<double> readings;
    for (std::string word; words >> word;) {
      char* end;
      readings.push_back(std::strtod(word.c_str(), &end));
      const bool all = end == word.c_str() + word.size();
      if (!all || word.find_first_of("xX(") != word.npos)  // 0x10, nan(1)
        throw std::invalid_argument("not a number: " + word);
    }
    if (readings.empty()) continue;
    const double *pose = arm.read(readings), *angles = pose + 12;
    for (size_t k = 0; k < readings.size(); ++k) std::printf("%.17g ", angles[k]);
    for (size_t k = 0; k < 12; ++k) std::printf("%.17g%c", pose[k], k == 11 ? '\n' : ' ');
  }
}
