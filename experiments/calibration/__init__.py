"""`touchdown calibrate`: rendered chessboard views, evaluation, figures."""
