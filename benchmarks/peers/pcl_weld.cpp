// Cloud to weld trajectory as the second paper describes it, on PCL alone. Lengths in mm.
//   pcl_weld CLOUD.ply ANSWER SMOOTHING RADIUS THRESHOLD_DEG
// The cloud is a binary PLY of float x y z. ANSWER receives one byte per point: 1 in the groove. One line of JSON on
// standard output: seconds per stage, memory, way points. RADIUS: normals and histograms.
#include <pcl/features/normal_3d_omp.h>
#include <pcl/point_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/segmentation/extract_clusters.h>
#include <pcl/surface/mls.h>

#include <Eigen/Eigenvalues>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "measured.h"
#include "ply.h"

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

constexpr double kVote = 5.0;  // vote and clusters
constexpr int kSlabs = 50;

// Standard deviations of the angles to the point's own normal and to the mean normal; the descriptor is the fourth
// root of the product of both variances, in degrees.
static std::vector<float> descriptor(const Cloud& cloud, const pcl::PointCloud<pcl::Normal>& normals,
                                     pcl::search::KdTree<pcl::PointXYZ>& tree, double radius) {
  Eigen::Vector3f mean = Eigen::Vector3f::Zero();
  for (const auto& n : normals)
    if (std::isfinite(n.normal_x)) mean += n.getNormalVector3fMap();
  mean.normalize();
  const float degrees = 180.0f / static_cast<float>(M_PI);
  std::vector<float> value(cloud.size(), 0.0f), toMean(cloud.size());
  for (std::size_t i = 0; i < cloud.size(); ++i)
    toMean[i] = std::acos(std::clamp(mean.dot(normals[i].getNormalVector3fMap()), -1.0f, 1.0f)) * degrees;
#pragma omp parallel
  {
    pcl::Indices near;
    std::vector<float> squared;
#pragma omp for schedule(dynamic, 512)
    for (int i = 0; i < static_cast<int>(cloud.size()); ++i) {
      tree.radiusSearch(cloud[i], radius, near, squared);
      double local = 0, local2 = 0, global = 0, global2 = 0;
      const Eigen::Vector3f own = normals[i].getNormalVector3fMap();
      for (int j : near) {
        const Eigen::Vector3f n = normals[j].getNormalVector3fMap();
        const float l = std::acos(std::clamp(own.dot(n), -1.0f, 1.0f)) * degrees;
        const float g = toMean[j];
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
  if (high <= low) return {mean};
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
  if (count != 6) return std::fprintf(stderr, "usage: pcl_weld CLOUD.ply ANSWER SMOOTHING RADIUS THRESHOLD_DEG\n"), 2;
  Laps laps;
  const Cloud::Ptr raw = readPly<pcl::PointXYZ>(words[1], 3);
  const double smoothing = std::atof(words[3]), radius = std::atof(words[4]), threshold = std::atof(words[5]);
  laps.lap("read");

  Cloud::Ptr cloud(new Cloud);
  pcl::MovingLeastSquares<pcl::PointXYZ, pcl::PointXYZ> mls;
  mls.setInputCloud(raw);
  mls.setSearchMethod(pcl::search::KdTree<pcl::PointXYZ>::Ptr(new pcl::search::KdTree<pcl::PointXYZ>));
  mls.setSearchRadius(smoothing);
  mls.setPolynomialOrder(2);
  mls.setNumberOfThreads(omp_get_max_threads());
  mls.process(*cloud);
  const pcl::Indices rows = mls.getCorrespondingIndices()->indices;
  laps.lap("smoothing");

  pcl::search::KdTree<pcl::PointXYZ>::Ptr tree(new pcl::search::KdTree<pcl::PointXYZ>(false));
  tree->setInputCloud(cloud);
  pcl::NormalEstimationOMP<pcl::PointXYZ, pcl::Normal> estimate(omp_get_max_threads());
  pcl::PointCloud<pcl::Normal> normals;
  estimate.setInputCloud(cloud);
  estimate.setSearchMethod(tree);
  estimate.setRadiusSearch(radius);
  estimate.compute(normals);
  laps.lap("normals");

  const std::vector<float> value = descriptor(*cloud, normals, *tree, radius);
  laps.lap("descriptor");

  const int size = static_cast<int>(cloud->size());
  std::vector<char> voted(size, 0);
#pragma omp parallel
  {
    pcl::Indices near;
    std::vector<float> squared;
#pragma omp for schedule(dynamic, 512)
    for (int i = 0; i < size; ++i) {
      if (value[i] <= threshold) continue;
      tree->radiusSearch((*cloud)[i], kVote, near, squared);
      std::size_t votes = 0;
      for (int j : near) votes += value[j] > threshold;
      voted[i] = 2 * votes > near.size();
    }
  }
  Cloud::Ptr high(new Cloud);
  pcl::Indices rowOf;
  for (int i = 0; i < size; ++i)
    if (voted[i]) high->push_back((*cloud)[i]), rowOf.push_back(i);
  std::vector<pcl::PointIndices> clusters;
  if (!high->empty()) {
    pcl::EuclideanClusterExtraction<pcl::PointXYZ> extract;
    extract.setInputCloud(high);
    extract.setSearchMethod(pcl::search::KdTree<pcl::PointXYZ>::Ptr(new pcl::search::KdTree<pcl::PointXYZ>(false)));
    extract.setClusterTolerance(kVote);
    extract.extract(clusters);  // largest first
  }
  pcl::Indices groove;
  if (!clusters.empty())
    for (int i : clusters[0].indices) groove.push_back(rowOf[i]);
  laps.lap("groove");

  const auto path = groove.empty() ? std::vector<Eigen::Vector3d>{} : wayPoints(*cloud, groove);
  laps.lap("trajectory");

  std::vector<char> labels(raw->size(), 0);
  for (int i : groove) labels[rows[i]] = 1;
  std::ofstream(words[2], std::ios::binary).write(labels.data(), labels.size());
  laps.print("\"path\": " + numbers(path));
}
