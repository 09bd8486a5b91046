"""What wheel odometry that lies does to every module."""
