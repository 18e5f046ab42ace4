"""Inference: goodness of fit, diagnosis and fits of a model against measurements, by simulation."""
