"""The method `lidar`: range maps through the network's LiDAR branch."""
