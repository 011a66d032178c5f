"""Self-supervised pretraining of both encoders by hiding a part and predicting it (thesis 4.5.1)."""
