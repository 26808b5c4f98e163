// Seconds per stage and memory of a program, printed as one line of JSON.
#pragma once
#include <sys/resource.h>

#include <chrono>
#include <cstdio>
#include <fstream>
#include <string>
#include <utility>
#include <vector>

class Laps {
 public:
  Laps() : last_(Clock::now()), begin_(last_), startKib_(memoryKib("VmRSS:")) {}

  void lap(const char* name) {
    const auto now = Clock::now();
    laps_.emplace_back(name, seconds(now - last_));
    last_ = now;
  }

  // What follows the last lap is not counted.
  void print(const std::string& answer) const {
    rusage used;
    getrusage(RUSAGE_SELF, &used);
    const double cpu = used.ru_utime.tv_sec + used.ru_stime.tv_sec + 1e-6 * (used.ru_utime.tv_usec + used.ru_stime.tv_usec);
    const double peak = memoryKib("VmHWM:");
    std::printf("{\"measured\": {\"wall_s\": %.6f, \"cpu_s\": %.6f, \"peak_mib\": %.2f, \"growth_mib\": %.2f}, \"laps_s\": {",
                seconds(last_ - begin_), cpu, peak / 1024, (peak - startKib_) / 1024);
    for (std::size_t i = 0; i < laps_.size(); ++i)
      std::printf("%s\"%s\": %.6f", i ? ", " : "", laps_[i].first.c_str(), laps_[i].second);
    std::printf("}%s%s}\n", answer.empty() ? "" : ", ", answer.c_str());
  }

 private:
  using Clock = std::chrono::steady_clock;

  static double seconds(Clock::duration span) { return std::chrono::duration<double>(span).count(); }

  static double memoryKib(const std::string& field) {
    std::ifstream status("/proc/self/status");
    for (std::string word; status >> word;)
      if (word == field) return status >> word, std::stod(word);
    return 0.0;
  }

  Clock::time_point last_, begin_;
  double startKib_;
  std::vector<std::pair<std::string, double>> laps_;
};
