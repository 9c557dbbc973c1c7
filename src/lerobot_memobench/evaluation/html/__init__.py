"""The report for the browser: `data` computes its figures, `write` fills the template and makes the folder."""
