"""The camera: model, undistortion, calibration and its uncertainty."""
