// SceneSLAM's protocol, version 1, for SLAM programs in C++17. Licence: MIT.
//
// Derive from sceneslam::Slam, and `return sceneslam::serve(my_slam);` in main. The program is
// started once per session and ends when its input is closed. What it prints on the standard
// output or error goes to SceneSLAM's log. docs/own_program.md describes the messages.
#pragma once

#include <unistd.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <exception>
#include <map>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace sceneslam {

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "arrays travel in little endian");

// The protocol's name of the type of an array's values.
template <class T>
std::string type_name() {
  static_assert(std::is_same_v<T, std::uint8_t> || (std::is_arithmetic_v<T> && sizeof(T) >= 4));
  const char kind = std::is_floating_point_v<T> ? 'f' : sizeof(T) == 1 ? 'u' : 'i';
  return {kind, static_cast<char>('0' + sizeof(T))};
}

// An array of up to three dimensions, row by row.
class Array {
 public:
  Array() = default;
  template <class T>
  Array(const std::vector<T>& values, std::vector<std::uint64_t> shape)
      : type(type_name<T>()), shape(std::move(shape)), bytes(values.size() * sizeof(T)) {
    if (size() != values.size()) throw std::invalid_argument("shape does not fit the values");
    if (!values.empty()) std::memcpy(bytes.data(), values.data(), bytes.size());
  }

  std::uint64_t size() const {
    std::uint64_t count = 1;
    for (auto length : shape) count *= length;
    return count;
  }
  // The values, of exactly this type: throws where they are of another.
  template <class T>
  const T* as() const {
    if (type != type_name<T>()) throw std::runtime_error("array is " + type);
    return reinterpret_cast<const T*>(bytes.data());
  }

  std::string type = "u1";
  std::vector<std::uint64_t> shape;
  std::vector<std::uint8_t> bytes;
};

// Named arrays: a rig, an observation, a map.
class Fields {
 public:
  bool has(const std::string& name) const { return arrays.count(name) > 0; }
  const Array& operator[](const std::string& name) const {
    const auto found = arrays.find(name);
    if (found == arrays.end()) throw std::runtime_error("no field " + name);
    return found->second;
  }
  template <class T>
  const T* values(const std::string& name) const { return (*this)[name].as<T>(); }
  std::array<double, 16> matrix(const std::string& name) const {
    std::array<double, 16> matrix;
    std::memcpy(matrix.data(), values<double>(name), sizeof matrix);
    return matrix;
  }
  std::string text(const std::string& name) const {
    const auto& bytes = (*this)[name].bytes;
    return std::string(bytes.begin(), bytes.end());
  }
  template <class T>
  void put(const std::string& name, const std::vector<T>& values,
           std::vector<std::uint64_t> shape = {}) {
    arrays[name] = Array(values, std::move(shape));  // no shape: a single value
  }
  void put_text(const std::string& name, const std::string& text) {
    put(name, std::vector<std::uint8_t>(text.begin(), text.end()), {text.size()});
  }

  std::map<std::string, Array> arrays;
};

enum class Status : std::int64_t { tracking = 0, degraded = 1, lost = 2 };

using Matrix4 = std::array<double, 16>;  // a rigid transform, row by row
using Matrix6 = std::array<double, 36>;  // a covariance: x y z [m], then rotations [rad], in base

inline Matrix4 identity() { return {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}; }

// The robot in `local`, which is its base at the first observation.
struct Pose {
  std::int64_t stamp_ns = 0;
  Matrix4 T_local_base = identity();
  Status status = Status::tracking;
  double quality_ratio = 1.0;  // 0 (nothing matched) to 1
  std::int64_t inliers = 0;
  bool has_covariance = false, has_map_covariance = false;  // for all poses of an answer, or none
  Matrix6 covariance{}, map_covariance{};  // the latter: of the drift of the program's own map
  bool can_begin = false;  // lost, and the sensors show enough to begin a map here
};

// A SLAM system. An exception ends the program; SceneSLAM goes on with another module.
class Slam {
 public:
  virtual ~Slam() = default;
  // The sets of sensors that suffice, one per line: image depth scan points odometry gyro accelerometer.
  virtual std::string sensors() const = 0;
  virtual void activate(const Fields& rig) = 0;
  // The pose at the observation; nothing where it is not known yet: it may come with a later one.
  virtual std::vector<Pose> track(const Fields& observation) = 0;
  virtual void set_scene(const std::string& /*scene*/) {}
  // All poses as best known now, by rising stamp; nothing where none was revised.
  virtual std::vector<Pose> trajectory() { return {}; }
  // points.points (N, 3) float, points.colors_bgr (N, 3) uint8, grid.log_odds (rows, columns)
  // float with grid.resolution_m and grid.origin_xy_m (2,) double, ...
  virtual Fields map() { return {}; }
  // Rises when the past was corrected, so that the pose jumps without a motion.
  virtual std::int64_t revision() const { return 0; }
};

namespace detail {

struct Head {
  char magic[8], kind[16];
  std::uint32_t number, count;
  std::uint64_t length;
};
struct FieldHead {
  char name[32], type[4];
  std::uint32_t dimensions;
  std::uint64_t shape[3];
};
static_assert(sizeof(Head) == 40 && sizeof(FieldHead) == 64, "as they travel");

inline void write_all(int file, const std::vector<std::uint8_t>& bytes) {
  for (std::size_t at = 0; at < bytes.size();) {
    const auto put = ::write(file, bytes.data() + at, bytes.size() - at);
    if (put <= 0) throw std::runtime_error("output is closed");
    at += static_cast<std::size_t>(put);
  }
}

inline Fields unpack(const std::vector<std::uint8_t>& bytes, std::uint32_t count) {
  Fields fields;
  std::size_t at = 0;
  for (std::uint32_t index = 0; index < count; ++index) {
    FieldHead head;
    std::memcpy(&head, bytes.data() + at, sizeof head), at += sizeof head;
    Array array;
    array.type = std::string(head.type, strnlen(head.type, sizeof head.type));
    array.shape.assign(head.shape, head.shape + head.dimensions);
    const std::size_t size = array.size() * static_cast<std::size_t>(array.type[1] - '0');
    array.bytes.assign(bytes.begin() + at, bytes.begin() + at + size);
    fields.arrays[std::string(head.name, strnlen(head.name, sizeof head.name))] = std::move(array);
    at += (size + 7) / 8 * 8;
  }
  return fields;
}

inline std::vector<std::uint8_t> pack(Head head, const Fields& fields) {
  std::vector<std::uint8_t> body;
  for (const auto& [name, array] : fields.arrays) {
    FieldHead field{};
    std::memcpy(field.name, name.data(), std::min(name.size(), sizeof field.name));
    std::memcpy(field.type, array.type.data(), array.type.size());
    field.dimensions = static_cast<std::uint32_t>(array.shape.size());
    for (std::size_t axis = 0; axis < 3; ++axis)
      field.shape[axis] = axis < array.shape.size() ? array.shape[axis] : 1;
    const auto* raw = reinterpret_cast<const std::uint8_t*>(&field);
    body.insert(body.end(), raw, raw + sizeof field);
    body.insert(body.end(), array.bytes.begin(), array.bytes.end());
    body.resize((body.size() + 7) / 8 * 8);
  }
  head.count = static_cast<std::uint32_t>(fields.arrays.size());
  head.length = body.size();
  const auto* raw = reinterpret_cast<const std::uint8_t*>(&head);
  body.insert(body.begin(), raw, raw + sizeof head);
  return body;
}

inline Fields as_fields(const std::vector<Pose>& poses) {
  std::vector<std::int64_t> stamps, statuses, inliers, begins;
  std::vector<double> transforms, qualities, covariances, of_map;
  const auto add = [](auto& to, const auto& from) { to.insert(to.end(), from.begin(), from.end()); };
  for (const auto& pose : poses) {
    stamps.push_back(pose.stamp_ns), statuses.push_back(static_cast<std::int64_t>(pose.status));
    inliers.push_back(pose.inliers), begins.push_back(pose.can_begin);
    qualities.push_back(pose.quality_ratio), add(transforms, pose.T_local_base);
    if (pose.has_covariance) add(covariances, pose.covariance);
    if (pose.has_map_covariance) add(of_map, pose.map_covariance);
  }
  const std::uint64_t count = poses.size();
  Fields fields;
  fields.put("stamps_ns", stamps, {count}), fields.put("status", statuses, {count});
  fields.put("quality_ratio", qualities, {count}), fields.put("inliers", inliers, {count});
  fields.put("T_local_base", transforms, {count, 4, 4}), fields.put("can_begin", begins, {count});
  if (!of_map.empty()) fields.put("map_covariance", of_map, {count, 6, 6});
  if (!covariances.empty()) fields.put("covariance", covariances, {count, 6, 6});
  return fields;
}

inline Fields reply(Slam& slam, const std::string& kind, const Fields& asked) {
  Fields fields;
  if (kind == "hello") fields.put_text("requires", slam.sensors());
  if (kind == "activate") slam.activate(asked);
  if (kind == "scene") slam.set_scene(asked.text("scene"));
  if (kind == "track")
    fields = as_fields(slam.track(asked)), fields.put<std::int64_t>("revision", {slam.revision()});
  if (kind == "trajectory") fields = as_fields(slam.trajectory());
  if (kind == "map") fields = slam.map();
  return fields;
}

}  // namespace detail

// Answers until the input is closed; returns the exit code for main.
inline int serve(Slam& slam) {
  const int wire = ::dup(1);
  ::dup2(2, 1);  // what a library prints must not get between the messages
  detail::Head head;
  while (std::fread(&head, sizeof head, 1, stdin) == 1) {
    std::vector<std::uint8_t> body(head.length);
    if (std::fread(body.data(), 1, body.size(), stdin) != body.size()) return 1;
    const std::string kind(head.kind, strnlen(head.kind, sizeof head.kind));
    try {
      const auto fields = detail::reply(slam, kind, detail::unpack(body, head.count));
      detail::write_all(wire, detail::pack(head, fields));
    } catch (const std::exception& error) {
      Fields fields;
      fields.put_text("text", error.what()), std::memcpy(head.kind, "error", 6);
      detail::write_all(wire, detail::pack(head, fields));
      return 1;
    }
  }
  return 0;
}

}  // namespace sceneslam
