//! Gives the shared library its name, by which programs that were linked with it find it. Below version 1 each minor version has
//! a layout of its own, and so a name of its own.

fn main() {
    let version = env!("CARGO_PKG_VERSION_MAJOR").to_owned() + "." + env!("CARGO_PKG_VERSION_MINOR");
    println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libconicflow.so.{version}");
    println!("cargo::rerun-if-changed=build.rs");
}
