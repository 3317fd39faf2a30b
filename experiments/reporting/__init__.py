"""Reports over many flights: statistics, tables, figures, words, HTML."""
