"""Reports over many flights: statistics, tables, figures, sentences, HTML."""
