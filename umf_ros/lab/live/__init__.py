"""The live graph on a recording: a player in place of the sensors, and the processes of a demo."""
