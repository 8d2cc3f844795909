"""VIOLearner: the network, its training and its covariance."""
