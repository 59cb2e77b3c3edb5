"""Calibration, fusion and the labelled GM-PHD tracker: sensor frames in, tracks out."""
