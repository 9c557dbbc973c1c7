"""How are results written down: tables, sections, formats, figures, pages for the browser."""
