"""Truth against prediction: scored views, calibration rows, folders of predictions."""
