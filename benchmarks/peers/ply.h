// Clouds in, points out.
#pragma once
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>

#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <sstream>
#include <string>
#include <vector>

// A binary PLY of so many floats a point: x y z, then nx ny nz where the point type has normals.
template <typename T>
typename pcl::PointCloud<T>::Ptr readPly(const std::string& name, int floats) {
  std::ifstream file(name, std::ios::binary);
  std::string line;
  std::size_t count = 0;
  while (std::getline(file, line) && line != "end_header")
    if (line.rfind("element vertex ", 0) == 0) count = std::stoul(line.substr(15));
  typename pcl::PointCloud<T>::Ptr cloud(new pcl::PointCloud<T>(count, 1));
  std::vector<float> numbers(floats * count);
  if (count == 0 || !file.read(reinterpret_cast<char*>(numbers.data()), numbers.size() * sizeof(float))) {
    std::fprintf(stderr, "%s is no binary PLY of %d floats a point\n", name.c_str(), floats);
    std::exit(2);
  }
  for (std::size_t i = 0; i < count; ++i) {
    (*cloud)[i].getVector3fMap() = Eigen::Map<Eigen::Vector3f>(&numbers[floats * i]);
    if constexpr (pcl::traits::has_normal<T>::value)
      (*cloud)[i].getNormalVector3fMap() = Eigen::Map<Eigen::Vector3f>(&numbers[floats * i + 3]);
  }
  return cloud;
}

// Points as a JSON list of lists.
template <typename V>
std::string numbers(const std::vector<V>& points) {
  std::ostringstream text;
  text.precision(9);
  for (std::size_t i = 0; i < points.size(); ++i)
    text << (i ? ", [" : "[") << points[i][0] << ", " << points[i][1] << ", " << points[i][2] << "]";
  return "[" + text.str() + "]";
}
