// The smallest SLAM program: it believes the wheels, and maps the path that it drove.
//
//   python -m sceneslam.modules.slam.process wheels ./wheels
//   python -m sceneslam +scenario=single slam@slam.only=process \
//       slam.only.command=[./wheels] allow_targets=[./wheels]
#include "sceneslam.hpp"

using sceneslam::Matrix4;

namespace {

Matrix4 product(const Matrix4& a, const Matrix4& b) {
  Matrix4 c{};
  for (int row = 0; row < 4; ++row)
    for (int column = 0; column < 4; ++column)
      for (int k = 0; k < 4; ++k) c[4 * row + column] += a[4 * row + k] * b[4 * k + column];
  return c;
}

Matrix4 inverse(const Matrix4& T) {
  Matrix4 inv = sceneslam::identity();
  for (int row = 0; row < 3; ++row) {
    inv[4 * row + 3] = 0;
    for (int k = 0; k < 3; ++k) {
      inv[4 * row + k] = T[4 * k + row];
      inv[4 * row + 3] -= T[4 * k + row] * T[4 * k + 3];
    }
  }
  return inv;
}

class Wheels : public sceneslam::Slam {
 public:
  std::string sensors() const override { return "odometry"; }

  void activate(const sceneslam::Fields&) override {}

  std::vector<sceneslam::Pose> track(const sceneslam::Fields& observation) override {
    sceneslam::Pose pose;
    pose.stamp_ns = *observation.values<std::int64_t>("stamp_ns");
    if (observation.has("T_odom_base")) {
      const Matrix4 T_odom_base = observation.matrix("T_odom_base");
      if (!is_started_) T_local_odom_ = inverse(T_odom_base);
      is_started_ = true;
      T_local_base_ = product(T_local_odom_, T_odom_base);
      for (int axis : {3, 7, 11}) path_.push_back(static_cast<float>(T_local_base_[axis]));
    } else {
      pose.status = sceneslam::Status::lost;
    }
    pose.T_local_base = T_local_base_;
    return {pose};
  }

  sceneslam::Fields map() override {
    sceneslam::Fields layers;
    layers.put("points.points", path_, {path_.size() / 3, 3});
    return layers;
  }

 private:
  bool is_started_ = false;
  Matrix4 T_local_odom_ = sceneslam::identity(), T_local_base_ = sceneslam::identity();
  std::vector<float> path_;
};

}  // namespace

int main() {
  Wheels wheels;
  return sceneslam::serve(wheels);
}
