"""Tables, figures and the page that tells how good a survey is."""
