"""Maps of many recordings: sessions that share one pose graph and one frame, and who finds himself in them again."""
