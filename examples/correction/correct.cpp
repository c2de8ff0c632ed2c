// correct correction.json < readings.txt    readings in each line; prints the true joint angles, then the marker's pose
// Build: g++ -std=c++17 -O2 correct.cpp -o correct
#include "correction.hpp"

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
      if (*end) throw std::invalid_argument("not a number: " + word);
    }
    if (readings.empty()) continue;
    arm.read(readings);
    for (double angle : arm.angles) std::printf("%.17g ", angle);
    for (size_t k = 0; k < 12; ++k) std::printf("%.17g%c", arm.pose[k], k == 11 ? '\n' : ' ');
  }
}
