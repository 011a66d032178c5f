"""Tools that make and judge the runtime: simulation, data sets, training, evaluation, playing to the live nodes."""
