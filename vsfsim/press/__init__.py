"""One press: result, text, figures, files, refinement."""
