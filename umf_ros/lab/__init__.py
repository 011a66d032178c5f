"""What makes and judges the runtime: simulation, data sets, training, evaluation, playing to the live nodes."""
