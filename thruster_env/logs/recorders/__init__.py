"""Files of recorders, one reader a format: autopilots' logs, bags of ROS, MATLAB and HDF5."""
