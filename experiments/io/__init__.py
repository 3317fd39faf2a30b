"""Files and formats. Nothing here flies."""
