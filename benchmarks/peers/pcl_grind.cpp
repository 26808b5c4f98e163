// The grinding pipeline and its stages on PCL, as its tutorials write them. Lengths in mm, clouds as binary PLY of
// float x y z. One line of JSON on standard output: seconds per stage, memory, and the answer.
//   pcl_grind detect SAMPLE TEST ANSWER SAMPLES plane|point   first alignment with so many SAC-IA samples, then ICP
//   pcl_grind coarse SAMPLE TEST ANSWER sacia|prerejective VOXEL TRIES
//   pcl_grind icp SAMPLE TEST ANSWER plane|point POSE         POSE: file of 16 doubles, row by row
//   pcl_grind difference SAMPLE TEST ANSWER threshold         TEST is already in the sample's frame
//   pcl_grind voxel CLOUD ANSWER SIZE        pcl_grind fpfh CLOUD ANSWER RADIUS   (CLOUD of x y z nx ny nz)
// ANSWER receives raw numbers: float32 points, distances or histograms; poses and paths stand in the JSON.
#include <pcl/features/fpfh_omp.h>
#include <pcl/features/normal_3d_omp.h>
#include <pcl/filters/voxel_grid.h>
#include <pcl/point_types.h>
#include <pcl/registration/ia_ransac.h>
#include <pcl/registration/icp.h>
#include <pcl/registration/sample_consensus_prerejective.h>
#include <pcl/search/kdtree.h>
#include <pcl/segmentation/extract_clusters.h>

#include <Eigen/Eigenvalues>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <string>
#include <vector>

#include "measured.h"
#include "ply.h"

using Point = pcl::PointXYZ;
using Cloud = pcl::PointCloud<Point>;
using Oriented = pcl::PointCloud<pcl::PointNormal>;
using Features = pcl::PointCloud<pcl::FPFHSignature33>;
using Pose = Eigen::Matrix4f;

constexpr float kFine = 1.0f;       // voxels for ICP
constexpr float kCoarse = 4.0f;     // voxels for the first alignment
constexpr float kThreshold = 0.5f;  // the difference
constexpr float kHighest = 4.0f, kBeside = 1.0f, kCluster = 1.5f;
constexpr int kPathPoints = 6;

static void write(const std::string& name, const std::vector<float>& numbers) {
  std::ofstream(name, std::ios::binary).write(reinterpret_cast<const char*>(numbers.data()), numbers.size() * 4);
}

static Cloud::Ptr thinned(const Cloud::Ptr& cloud, float size) {
  Cloud::Ptr less(new Cloud);
  pcl::VoxelGrid<Point> grid;
  grid.setInputCloud(cloud);
  grid.setLeafSize(size, size, size);
  grid.filter(*less);
  return less;
}

static Oriented::Ptr withNormals(const Cloud::Ptr& cloud, float radius) {
  Oriented::Ptr oriented(new Oriented);
  pcl::NormalEstimationOMP<Point, pcl::PointNormal> estimate;  // towards the origin, where the scanner stands
  estimate.setInputCloud(cloud);
  estimate.setRadiusSearch(radius);
  estimate.compute(*oriented);
  for (std::size_t i = 0; i < cloud->size(); ++i) (*oriented)[i].getVector3fMap() = (*cloud)[i].getVector3fMap();
  return oriented;
}

static Features::Ptr features(const Oriented::Ptr& cloud, float radius) {
  Features::Ptr found(new Features);
  pcl::FPFHEstimationOMP<pcl::PointNormal, pcl::PointNormal, pcl::FPFHSignature33> estimate;
  estimate.setInputCloud(cloud);
  estimate.setInputNormals(cloud);
  estimate.setRadiusSearch(radius);
  estimate.compute(*found);
  return found;
}

template <typename Method>
static Pose aligned(Method& method, const Oriented::Ptr& source, const Features::Ptr& sourceFeatures,
                    const Oriented::Ptr& target, const Features::Ptr& targetFeatures, int tries) {
  Oriented moved;
  method.setInputSource(source);
  method.setSourceFeatures(sourceFeatures);
  method.setInputTarget(target);
  method.setTargetFeatures(targetFeatures);
  method.setMaximumIterations(tries);
  method.align(moved);
  return method.getFinalTransformation();
}

static Pose firstPose(const Cloud::Ptr& target, const Cloud::Ptr& source, const std::string& method, float voxel,
                      int tries, Laps& laps) {
  const Oriented::Ptr a = withNormals(thinned(source, voxel), 2.5f * voxel);
  const Oriented::Ptr b = withNormals(thinned(target, voxel), 2.5f * voxel);
  const Features::Ptr fa = features(a, 5.0f * voxel), fb = features(b, 5.0f * voxel);
  laps.lap("features");
  Pose pose;
  if (method == "sacia") {
    pcl::SampleConsensusInitialAlignment<pcl::PointNormal, pcl::PointNormal, pcl::FPFHSignature33> sac;
    sac.setMinSampleDistance(20.0f);
    sac.setMaxCorrespondenceDistance(2 * voxel * 2 * voxel);  // PCL compares squared distances with it
    sac.setCorrespondenceRandomness(5);
    pose = aligned(sac, a, fa, b, fb, tries);
  } else {
    pcl::SampleConsensusPrerejective<pcl::PointNormal, pcl::PointNormal, pcl::FPFHSignature33> sac;
    sac.setNumberOfSamples(3);
    sac.setCorrespondenceRandomness(5);
    sac.setSimilarityThreshold(0.9f);
    sac.setMaxCorrespondenceDistance(1.5f * voxel);
    sac.setInlierFraction(0.25f);
    pose = aligned(sac, a, fa, b, fb, tries);
  }
  laps.lap("coarse");
  return pose;
}

template <typename Icp, typename C>
static Pose refined(Icp& icp, const C& source, const C& target, const Pose& start, float most, int iterations) {
  typename C::element_type moved;
  icp.setInputSource(source);
  icp.setInputTarget(target);
  icp.setMaxCorrespondenceDistance(most);
  icp.setMaximumIterations(iterations);
  icp.setTransformationEpsilon(1e-9);
  icp.setEuclideanFitnessEpsilon(1e-9);
  icp.align(moved, start);
  return icp.getFinalTransformation();
}

static Pose icpPose(const Oriented::Ptr& source, const Oriented::Ptr& target, const std::string& method, Pose pose) {
  if (method == "point") {
    pcl::IterativeClosestPoint<pcl::PointNormal, pcl::PointNormal> icp;
    return refined(icp, source, target, pose, 4.0f, 400);
  }
  pcl::IterativeClosestPointWithNormals<pcl::PointNormal, pcl::PointNormal> icp;
  for (float most : {4.0f, 1.0f}) pose = refined(icp, source, target, pose, most, 30);
  return pose;
}

static std::vector<float> distances(const Cloud::Ptr& sample, const Cloud& test) {
  pcl::search::KdTree<Point> tree(false);
  tree.setInputCloud(sample);
  std::vector<float> away(test.size());
#pragma omp parallel
  {
    pcl::Indices near(1);
    std::vector<float> squared(1);
#pragma omp for
    for (int i = 0; i < static_cast<int>(test.size()); ++i) {
      tree.nearestKSearch(test[i], 1, near, squared);
      away[i] = std::sqrt(squared[0]);
    }
  }
  return away;
}

// Path along the largest cluster that stands out: its longest axis in equal slabs, in each the mean of the highest
// quarter. The same recipe as the Python peers' (recipe.py).
static std::vector<Eigen::Vector3f> path(const Cloud& test, const Cloud& moved, const std::vector<float>& away,
                                         const Oriented::Ptr& surface) {
  pcl::search::KdTree<pcl::PointNormal> tree(false);
  tree.setInputCloud(surface);
  Cloud::Ptr high(new Cloud);
  std::vector<float> heights;
  pcl::Indices near(1);
  std::vector<float> squared(1);
  for (std::size_t i = 0; i < test.size(); ++i) {
    if (away[i] <= kThreshold || away[i] >= kHighest) continue;
    pcl::PointNormal query;
    query.getVector3fMap() = moved[i].getVector3fMap();
    tree.nearestKSearch(query, 1, near, squared);
    const auto& foot = (*surface)[near[0]];
    const float height = foot.getNormalVector3fMap().dot(query.getVector3fMap() - foot.getVector3fMap());
    if (height <= kThreshold || squared[0] - height * height >= kBeside * kBeside) continue;
    high->push_back(test[i]);
    heights.push_back(height);
  }
  std::vector<Eigen::Vector3f> points;
  if (high->size() < 4 * kPathPoints) return points;
  std::vector<pcl::PointIndices> clusters;
  pcl::EuclideanClusterExtraction<Point> extract;
  extract.setInputCloud(high);
  extract.setClusterTolerance(kCluster);
  extract.extract(clusters);  // largest first
  Eigen::MatrixXf own(clusters[0].indices.size(), 3);
  for (int i = 0; i < own.rows(); ++i) own.row(i) = (*high)[clusters[0].indices[i]].getVector3fMap().transpose();
  const Eigen::MatrixXf centred = own.rowwise() - own.colwise().mean();
  const Eigen::Matrix3f spread = centred.transpose() * centred;
  const Eigen::VectorXf along = centred * Eigen::SelfAdjointEigenSolver<Eigen::Matrix3f>(spread).eigenvectors().col(2);
  const float low = along.minCoeff(), length = along.maxCoeff() - low;
  std::vector<std::vector<std::pair<float, int>>> slabs(kPathPoints);
  for (int i = 0; i < own.rows(); ++i)
    slabs[std::min<int>(kPathPoints - 1, kPathPoints * (along[i] - low) / length)].emplace_back(
        -heights[clusters[0].indices[i]], i);
  for (auto& slab : slabs) {
    if (slab.empty()) continue;
    std::sort(slab.begin(), slab.end());
    const int count = std::max<int>(slab.size() / 4, 1);
    Eigen::Vector3f mean = Eigen::Vector3f::Zero();
    for (int i = 0; i < count; ++i) mean += own.row(slab[i].second).transpose() / count;
    points.push_back(mean);
  }
  return points;
}

static std::string numbers(const Pose& pose) {
  std::ostringstream text;
  text.precision(9);
  for (int i = 0; i < 16; ++i) text << (i ? ", " : "[") << pose(i / 4, i % 4);
  return text.str() + "]";
}

int main(int count, char** words) {
  Laps laps;
  const std::vector<std::string> word(words, words + count);
  const std::string task = count > 1 ? word[1] : "";
  std::string answer;
  if (task == "detect" && count == 7) {
    const Cloud::Ptr sample = readPly<Point>(word[2], 3), test = readPly<Point>(word[3], 3);
    laps.lap("read");
    const Cloud::Ptr target = thinned(sample, kFine), source = thinned(test, kFine);
    laps.lap("voxel");
    Pose pose = firstPose(target, source, "sacia", kCoarse, std::atoi(words[5]), laps);
    const Oriented::Ptr surface = withNormals(target, 3.0f), points = withNormals(source, 3.0f);
    pose = icpPose(points, surface, word[6], pose);
    laps.lap("icp");
    Cloud moved;
    pcl::transformPointCloud(*test, moved, pose);
    const std::vector<float> away = distances(sample, moved);
    laps.lap("difference");
    answer = "\"T_sample_test\": " + numbers(pose) + ", \"path\": " + numbers(path(*test, moved, away, surface));
    laps.lap("path");
  } else if (task == "coarse" && count == 8) {
    const Cloud::Ptr sample = readPly<Point>(word[2], 3), test = readPly<Point>(word[3], 3);
    laps.lap("read");
    answer = "\"T_sample_test\": " +
             numbers(firstPose(sample, test, word[5], std::atof(words[6]), std::atoi(words[7]), laps));
  } else if (task == "icp" && count == 7) {
    const Cloud::Ptr sample = readPly<Point>(word[2], 3), test = readPly<Point>(word[3], 3);
    double start[16];
    std::ifstream(word[6], std::ios::binary).read(reinterpret_cast<char*>(start), sizeof start);
    laps.lap("read");
    const Oriented::Ptr target = withNormals(thinned(sample, kFine), 3.0f), source = withNormals(thinned(test, kFine), 3.0f);
    laps.lap("prepare");
    const Pose pose = Eigen::Map<Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(start).cast<float>();
    answer = "\"T_sample_test\": " + numbers(icpPose(source, target, word[5], pose));
    laps.lap("icp");
  } else if (task == "difference" && count == 5) {
    const Cloud::Ptr sample = readPly<Point>(word[2], 3), test = readPly<Point>(word[3], 3);
    laps.lap("read");
    const std::vector<float> away = distances(sample, *test);
    laps.lap("difference");
    write(word[4], away);
  } else if (task == "voxel" && count == 5) {
    const Cloud::Ptr cloud = readPly<Point>(word[2], 3);
    laps.lap("read");
    const Cloud::Ptr less = thinned(cloud, std::atof(words[4]));
    laps.lap("voxel");
    std::vector<float> xyz;
    for (const auto& p : *less) xyz.insert(xyz.end(), {p.x, p.y, p.z});
    write(word[3], xyz);
  } else if (task == "fpfh" && count == 5) {
    const Oriented::Ptr cloud = readPly<pcl::PointNormal>(word[2], 6);
    laps.lap("read");
    const Features::Ptr found = features(cloud, std::atof(words[4]));
    laps.lap("fpfh");
    std::vector<float> rows;
    for (const auto& f : *found) rows.insert(rows.end(), f.histogram, f.histogram + 33);
    write(word[3], rows);
  } else {
    return std::fprintf(stderr, "usage: see the first lines of pcl_grind.cpp\n"), 2;
  }
  laps.print(answer);
}
