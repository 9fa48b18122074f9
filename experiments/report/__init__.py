"""From numbers to tables, figures, HTML, CSV, MATLAB. Imports metrics."""
