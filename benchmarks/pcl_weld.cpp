// Cloud to weld trajectory as the second paper describes it, on PCL alone: the peer of chapters 10 and 11.
// Build:  g++ -O3 -fopenmp pcl_weld.cpp -o pcl_weld -I/usr/include/pcl-1.13 -I/usr/include/eigen3
//         -lpcl_common -lpcl_search -lpcl_kdtree -lpcl_features -lpcl_surface -lpcl_segmentation -lpcl_filters
// Run:    pcl_weld CLOUD.f32 SMOOTHING_MM THRESHOLD_DEG   (float32 x y z in mm; one line of JSON on standard output)
#include <pcl/features/normal_3d_omp.h>
#include <pcl/point_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/segmentation/extract_clusters.h>
#include <pcl/surface/mls.h>

#include <Eigen/Eigenvalues>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <vector>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;
using Clock = std::chrono::steady_clock;

constexpr double kRadius = 5.0;  // normals, histograms, vote and clusters, mm
constexpr int kSlabs = 50;

static Cloud::Ptr read(const char* name) {
  std::ifstream file(name, std::ios::binary);
  Cloud::Ptr cloud(new Cloud);
  float xyz[3];
  while (file.read(reinterpret_cast<char*>(xyz), sizeof xyz)) cloud->emplace_back(xyz[0], xyz[1], xyz[2]);
  return cloud;
}

// Standard deviations of the angles to the point's own normal and to the mean normal; the descriptor is the fourth
// root of the product of both variances, in degrees.
static std::vector<float> descriptor(const Cloud& cloud, const pcl::PointCloud<pcl::Normal>& normals,
                                     pcl::search::KdTree<pcl::PointXYZ>& tree) {
  Eigen::Vector3f mean = Eigen::Vector3f::Zero();
  for (const auto& n : normals)
    if (std::isfinite(n.normal_x)) mean += n.getNormalVector3fMap();
  mean.normalize();
  const float degrees = 180.0f / static_cast<float>(M_PI);
  std::vector<float> value(cloud.size(), 0.0f);
#pragma omp parallel
  {
    pcl::Indices near;
    std::vector<float> squared;
#pragma omp for schedule(dynamic, 512)
    for (int i = 0; i < static_cast<int>(cloud.size()); ++i) {
      tree.radiusSearch(cloud[i], kRadius, near, squared);
      double local = 0, local2 = 0, global = 0, global2 = 0;
      const Eigen::Vector3f own = normals[i].getNormalVector3fMap();
      for (int j : near) {
        const Eigen::Vector3f n = normals[j].getNormalVector3fMap();
        const float l = std::acos(std::clamp(own.dot(n), -1.0f, 1.0f)) * degrees;
        const float g = std::acos(std::clamp(mean.dot(n), -1.0f, 1.0f)) * degrees;
        local += l, local2 += l * l, global += g, global2 += g * g;
      }
      const double count = near.size();
      const double v = (local2 / count - std::pow(local / count, 2)) * (global2 / count - std::pow(global / count, 2));
      value[i] = std::pow(std::max(v, 0.0), 0.25);
    }
  }
  return value;
}

static Eigen::Vector3d geometricMedian(const std::vector<Eigen::Vector3d>& points) {
  Eigen::Vector3d at = Eigen::Vector3d::Zero();
  for (const auto& p : points) at += p / points.size();
  for (int round = 0; round < 1000; ++round) {
    Eigen::Vector3d pull = Eigen::Vector3d::Zero();
    double weight = 0;
    for (const auto& p : points) {
      const double w = 1.0 / std::max((p - at).norm(), 1e-9);
      pull += w * p, weight += w;
    }
    const Eigen::Vector3d next = pull / weight;
    const bool still = (next - at).norm() < 1e-4;
    at = next;
    if (still) break;
  }
  return at;
}

static std::vector<Eigen::Vector3d> wayPoints(const Cloud& cloud, const pcl::Indices& groove) {
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (int i : groove) mean += cloud[i].getVector3fMap().cast<double>() / groove.size();
  Eigen::Matrix3d spread = Eigen::Matrix3d::Zero();
  for (int i : groove) {
    const Eigen::Vector3d d = cloud[i].getVector3fMap().cast<double>() - mean;
    spread += d * d.transpose();
  }
  const Eigen::Vector3d axis = Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(spread).eigenvectors().col(2);
  double low = 1e9, high = -1e9;
  for (int i : groove) {
    const double s = axis.dot(cloud[i].getVector3fMap().cast<double>());
    low = std::min(low, s), high = std::max(high, s);
  }
  std::vector<std::vector<Eigen::Vector3d>> slabs(kSlabs);
  for (int i : groove) {
    const Eigen::Vector3d p = cloud[i].getVector3fMap().cast<double>();
    slabs[std::min<int>(kSlabs - 1, kSlabs * (axis.dot(p) - low) / (high - low))].push_back(p);
  }
  std::vector<Eigen::Vector3d> path;
  for (const auto& slab : slabs)
    if (!slab.empty()) path.push_back(geometricMedian(slab));
  return path;
}

int main(int count, char** words) {
  if (count != 4) return std::fprintf(stderr, "usage: pcl_weld CLOUD.f32 SMOOTHING_MM THRESHOLD_DEG\n"), 2;
  const Cloud::Ptr raw = read(words[1]);
  if (raw->size() < 100) return std::fprintf(stderr, "pcl_weld: %s holds no cloud\n", words[1]), 2;
  const double smoothing = std::atof(words[2]), threshold = std::atof(words[3]);
  std::vector<Clock::time_point> marks{Clock::now()};

  Cloud::Ptr cloud(new Cloud);
  pcl::MovingLeastSquares<pcl::PointXYZ, pcl::PointXYZ> mls;
  mls.setInputCloud(raw);
  mls.setSearchMethod(pcl::search::KdTree<pcl::PointXYZ>::Ptr(new pcl::search::KdTree<pcl::PointXYZ>));
  mls.setSearchRadius(smoothing);
  mls.setPolynomialOrder(2);
  mls.setNumberOfThreads(omp_get_max_threads());
  mls.process(*cloud);
  marks.push_back(Clock::now());

  pcl::search::KdTree<pcl::PointXYZ>::Ptr tree(new pcl::search::KdTree<pcl::PointXYZ>);
  tree->setInputCloud(cloud);
  pcl::NormalEstimationOMP<pcl::PointXYZ, pcl::Normal> estimate(omp_get_max_threads());
  pcl::PointCloud<pcl::Normal> normals;
  estimate.setInputCloud(cloud);
  estimate.setSearchMethod(tree);
  estimate.setRadiusSearch(kRadius);
  estimate.compute(normals);
  marks.push_back(Clock::now());

  const std::vector<float> value = descriptor(*cloud, normals, *tree);
  marks.push_back(Clock::now());

  pcl::IndicesPtr high(new pcl::Indices);
  pcl::Indices near;
  std::vector<float> squared;
  for (int i = 0; i < static_cast<int>(cloud->size()); ++i) {
    if (value[i] <= threshold) continue;
    tree->radiusSearch((*cloud)[i], kRadius, near, squared);
    std::size_t votes = 0;
    for (int j : near) votes += value[j] > threshold;
    if (2 * votes > near.size()) high->push_back(i);
  }
  std::vector<pcl::PointIndices> clusters;
  pcl::EuclideanClusterExtraction<pcl::PointXYZ> extract;
  extract.setInputCloud(cloud);
  extract.setIndices(high);
  extract.setSearchMethod(pcl::search::KdTree<pcl::PointXYZ>::Ptr(new pcl::search::KdTree<pcl::PointXYZ>));
  extract.setClusterTolerance(kRadius);
  extract.extract(clusters);
  marks.push_back(Clock::now());

  const auto path = clusters.empty() ? std::vector<Eigen::Vector3d>{} : wayPoints(*cloud, clusters[0].indices);
  marks.push_back(Clock::now());

  const char* stages[] = {"smoothing_s", "normals_s", "descriptor_s", "groove_s", "trajectory_s"};
  std::printf("{\"points\": %zu, \"groove_points\": %zu, \"way_points\": %zu", raw->size(),
              clusters.empty() ? 0 : clusters[0].indices.size(), path.size());
  for (int i = 0; i < 5; ++i)
    std::printf(", \"%s\": %.4f", stages[i], std::chrono::duration<double>(marks[i + 1] - marks[i]).count());
  std::printf(", \"total_s\": %.4f}\n", std::chrono::duration<double>(marks.back() - marks.front()).count());
}
