"""What pictures share, wherever they are drawn: by metrics, by data sets, by reports."""
