"""Pre-training and metric learning."""
