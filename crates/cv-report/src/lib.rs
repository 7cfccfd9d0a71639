//! Overlays, colour maps, plots and the self-contained HTML report.
