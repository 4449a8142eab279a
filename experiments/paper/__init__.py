"""The figures and tables of the paper: their runs, the CSV files, one script per figure."""
