"""Maps of real scans, compared with points that were held out."""
