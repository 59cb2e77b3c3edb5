"""PCGAN: the predictor network, its training, and the process that serves it."""
