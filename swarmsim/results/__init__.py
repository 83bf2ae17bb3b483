"""What a run leaves behind: the record of a mission, its summary, and the files of a run."""
