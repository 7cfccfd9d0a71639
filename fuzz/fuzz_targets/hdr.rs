#![no_main]
libfuzzer_sys::fuzz_target!(init: cv_fuzz::start(), |bytes: &[u8]| -> libfuzzer_sys::Corpus { cv_fuzz::parsers::image("hdr", bytes) });
