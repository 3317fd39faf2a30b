"""`forest`: wooded hills with clearings, a brook and a track."""
