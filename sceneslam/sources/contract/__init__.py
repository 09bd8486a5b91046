"""What makes any source keep its contract: rising stamps, finite arrays, smooth odometry."""
