// 2D laser SLAM by MRPT's Rao-Blackwellized particle filter, Gmapping's method: every particle
// holds a path and a map, and scan matching in its own map proposes where it moves.
// MRPT 2 (libmrpt-dev, BSD-3) has to be installed.
//
//   python -m sceneslam.modules.slam.process mrpt_rbpf ./mrpt_rbpf
//   python -m sceneslam +scenario=single source=carmen source.path=FILE \
//       slam@slam.only=process slam.only.command=[./mrpt_rbpf] allow_targets=[./mrpt_rbpf]
//
// Usage: mrpt_rbpf [particles] [resolution in metres]
#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/maps/CSimplePointsMap.h>
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/poses/CPose3DPDF.h>
#include <mrpt/random.h>
#include <mrpt/slam/CMetricMapBuilderRBPF.h>

#include <cmath>
#include <memory>

#include "sceneslam.hpp"

using mrpt::maps::COccupancyGridMap2D;
using mrpt::maps::CSimplePointsMap;
using mrpt::poses::CPose2D;
using mrpt::slam::CMetricMapBuilderRBPF;

namespace {

// The values are those of MRPT's own example for the Intel log, gridmapping_RBPF_ICPbased_intel.ini.
constexpr double kStepM = 0.2;        // the filter takes a scan after so much motion; ...
constexpr double kTurnRad = 0.175;    // ... as far as that odometry is exact enough
constexpr float kInsertM = 2.0F;      // a scan joins the maps after so much motion
constexpr float kInsertRad = 0.52F;
constexpr float kMatchedMin = 0.8F;   // of a scan, for its match to be the proposal
constexpr float kPointsM = 0.05F;     // between the points of a map

CMetricMapBuilderRBPF::TConstructionOptions options(unsigned particles, double resolution_m) {
  CMetricMapBuilderRBPF::TConstructionOptions options;
  options.verbosity_level = mrpt::system::LVL_ERROR;
  options.localizeLinDistance = options.localizeAngDistance = 0.0F;  // steps are made here
  options.insertionLinDistance = kInsertM;
  options.insertionAngDistance = kInsertRad;
  options.PF_options.PF_algorithm = mrpt::bayes::CParticleFilter::pfOptimalProposal;
  options.PF_options.sampleSize = particles;
  auto& prediction = options.predictionOptions;
  prediction.pfOptimalProposal_mapSelection = 3;  // matches scans with the map of points
  prediction.ICPGlobalAlign_MinQuality = kMatchedMin;
  prediction.icp_params.ICP_algorithm = mrpt::slam::icpLevenbergMarquardt;
  prediction.icp_params.maxIterations = 60;
  prediction.icp_params.thresholdDist = 1.0;
  prediction.icp_params.thresholdAng = mrpt::DEG2RAD(5.0);
  CSimplePointsMap::TMapDefinition points;
  points.insertionOpts.minDistBetweenLaserPoints = kPointsM;
  points.insertionOpts.fuseWithExisting = false;
  points.insertionOpts.isPlanarMap = true;
  points.likelihoodOpts.max_corr_distance = 5.0;
  points.likelihoodOpts.sigma_dist = 0.05;
  options.mapsInitializers.push_back(points);
  COccupancyGridMap2D::TMapDefinition grid;
  grid.resolution = static_cast<float>(resolution_m);
  grid.genericMapParams.enableObservationLikelihood = false;  // it is drawn, and judges nothing
  options.mapsInitializers.push_back(grid);
  return options;
}

CPose2D planar(const sceneslam::Matrix4& T) {
  return {T[3], T[7], std::atan2(T[4], T[0])};
}

sceneslam::Matrix4 spatial(const CPose2D& pose) {
  const double c = std::cos(pose.phi()), s = std::sin(pose.phi());
  return {c, -s, 0, pose.x(), s, c, 0, pose.y(), 0, 0, 1, 0, 0, 0, 0, 1};
}

class ParticleFilterSlam : public sceneslam::Slam {
 public:
  ParticleFilterSlam(unsigned particles, double resolution_m)
      : builder_(options(particles, resolution_m)) {
    mrpt::random::getRandomGenerator().randomize(1);  // the same run twice
  }

  std::string sensors() const override { return "scan odometry"; }

  void activate(const sceneslam::Fields& rig) override {
    laser_ = planar(rig.matrix("laser.T_base_laser"));
  }

  std::vector<sceneslam::Pose> track(const sceneslam::Fields& observation) override {
    sceneslam::Pose pose;
    pose.stamp_ns = *observation.values<std::int64_t>("stamp_ns");
    if (observation.has("T_odom_base")) {
      const CPose2D odometry = planar(observation.matrix("T_odom_base"));
      if (stamps_ns_.empty()) odometry_at_step_ = odometry;
      const CPose2D moved = odometry - odometry_at_step_;
      const bool is_far = moved.norm() > kStepM || std::abs(moved.phi()) > kTurnRad;
      if (observation.has("scan.ranges_m") && (is_far || stamps_ns_.empty())) {
        step(moved, observation, pose.stamp_ns);
        odometry_at_step_ = odometry;
      }
      pose_ = at_step_ + (odometry - odometry_at_step_);
    } else {
      pose.status = sceneslam::Status::lost;
    }
    pose.T_local_base = spatial(pose_);
    return {pose};
  }

  // The path of the likeliest particle.
  std::vector<sceneslam::Pose> trajectory() override {
    std::deque<mrpt::math::TPose3D> path;
    builder_.getCurrentMostLikelyPath(path);
    std::vector<sceneslam::Pose> poses;
    const std::size_t extra = path.size() - std::min(path.size(), stamps_ns_.size());
    for (std::size_t i = extra; i < path.size(); ++i) {  // it may begin before the first step
      sceneslam::Pose pose;
      pose.stamp_ns = stamps_ns_[i - extra];
      pose.T_local_base = spatial(CPose2D(path[i].x, path[i].y, path[i].yaw));
      poses.push_back(pose);
    }
    return poses;
  }

  sceneslam::Fields map() override {
    sceneslam::Fields layers;
    const auto grid =
        builder_.mapPDF.getCurrentMostLikelyMetricMap()->mapByClass<COccupancyGridMap2D>();
    const unsigned columns = grid->getSizeX(), rows = grid->getSizeY();
    std::vector<float> log_odds;
    for (unsigned row = 0; row < rows; ++row)
      for (unsigned column = 0; column < columns; ++column) {
        const float is_free = grid->getCell(static_cast<int>(column), static_cast<int>(row));
        const float bounded = std::clamp(is_free, 0.01F, 0.99F);
        log_odds.push_back(is_free == 0.5F ? 0.0F : std::log((1.0F - bounded) / bounded));
      }
    layers.put("grid.log_odds", log_odds, {rows, columns});
    layers.put<double>("grid.resolution_m", {grid->getResolution()});
    layers.put<double>("grid.origin_xy_m", {grid->getXMin(), grid->getYMin()}, {2});
    return layers;
  }

 private:
  // Moves all particles by what odometry says and the scan corrects.
  void step(const CPose2D& moved, const sceneslam::Fields& observation, std::int64_t stamp_ns) {
    mrpt::obs::CActionRobotMovement2D action;
    mrpt::obs::CActionRobotMovement2D::TMotionModelOptions model;
    model.modelSelection = mrpt::obs::CActionRobotMovement2D::mmGaussian;
    action.computeFromOdometry(moved, model);
    mrpt::obs::CActionCollection actions(action);
    mrpt::obs::CSensoryFrame frame;
    frame.insert(scan(observation));
    builder_.processActionObservation(actions, frame);
    at_step_ = CPose2D(builder_.getCurrentPoseEstimation()->getMeanVal());
    stamps_ns_.push_back(stamp_ns);
  }

  mrpt::obs::CObservation2DRangeScan::Ptr scan(const sceneslam::Fields& observation) const {
    auto scan = mrpt::obs::CObservation2DRangeScan::Create();
    const auto& ranges = observation["scan.ranges_m"];
    const double first = *observation.values<double>("scan.angle_min_rad");
    const double step = *observation.values<double>("scan.angle_step_rad");
    const double nearest = *observation.values<double>("scan.range_min_m");
    const double farthest = *observation.values<double>("scan.range_max_m");
    const auto count = ranges.size();
    scan->aperture = static_cast<float>(step * static_cast<double>(count - 1));
    scan->rightToLeft = true;
    scan->maxRange = static_cast<float>(farthest);
    const CPose2D centre(0, 0, first + 0.5 * scan->aperture);  // beams lie around it
    scan->sensorPose = mrpt::poses::CPose3D(laser_ + centre);
    scan->resizeScan(count);
    for (std::size_t i = 0; i < count; ++i) {
      const float range = ranges.as<float>()[i];
      scan->setScanRange(i, std::isfinite(range) ? range : static_cast<float>(farthest));
      scan->setScanRangeValidity(i, range >= nearest && range < farthest);
    }
    return scan;
  }

  CMetricMapBuilderRBPF builder_;
  CPose2D laser_, odometry_at_step_, at_step_, pose_;
  std::vector<std::int64_t> stamps_ns_;  // of the steps
};

}  // namespace

int main(int argc, char** argv) {
  const int particles = argc > 1 ? std::stoi(argv[1]) : 15;
  ParticleFilterSlam slam(static_cast<unsigned>(particles), argc > 2 ? std::stod(argv[2]) : 0.05);
  return sceneslam::serve(slam);
}
