"""2D laser SLAM: scan matching with odometry as prior."""
