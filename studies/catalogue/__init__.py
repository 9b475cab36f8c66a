"""The studies, a module each: what is varied, what is measured, what is claimed.  They import no science; `contents` lists them."""
