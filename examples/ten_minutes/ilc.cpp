#include <curl/curl.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <nlohmann/json.hpp>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

using nlohmann::json;
using Torque = std::vector<double>;
static volatile std::sig_atomic_t interrupted = 0;
static bool playing = false;  // a trial may be playing: whoever ends now presses stop

// The service has understood and said no: nothing was begun.
struct refused : std::runtime_error {
    using std::runtime_error::runtime_error;
};

static size_t keep(char *data, size_t one, size_t count, void *into) {
    static_cast<std::string *>(into)->append(data, one * count);
    return one * count;
}

// One request: the answer's text; etag, where it is given, is sent as If-Match if it is full and filled if it is empty.
static std::string ask(const std::string &path, const std::string &body = "", std::string *etag = nullptr) {
    std::string text, head;
    const char *url = std::getenv("URL");
    curl_slist *lines = curl_slist_append(nullptr, "Content-Type: application/json");
    lines = curl_slist_append(lines, (std::string("Authorization: Bearer ") + std::getenv("KEY")).c_str());
    if (etag && !etag->empty()) lines = curl_slist_append(lines, ("If-Match: " + *etag).c_str());
    CURL *curl = curl_easy_init();
    curl_easy_setopt(curl, CURLOPT_URL, ((url ? url : "http://127.0.0.1:8000") + path).c_str());
    curl_easy_setopt(curl, CURLOPT_HTTPHEADER, lines);
    curl_easy_setopt(curl, CURLOPT_TIMEOUT, 60L);
    curl_easy_setopt(curl, CURLOPT_WRITEFUNCTION, keep);
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, &text);
    curl_easy_setopt(curl, CURLOPT_HEADERFUNCTION, keep);
    curl_easy_setopt(curl, CURLOPT_HEADERDATA, &head);
    if (!body.empty()) curl_easy_setopt(curl, CURLOPT_POSTFIELDS, body.c_str());
    const CURLcode sent = curl_easy_perform(curl);
    long status = 0;
    curl_easy_getinfo(curl, CURLINFO_RESPONSE_CODE, &status);
    curl_easy_cleanup(curl);
    curl_slist_free_all(lines);
    if (sent != CURLE_OK) throw std::runtime_error(curl_easy_strerror(sent));
    if (status >= 500) throw std::runtime_error(text);
    if (status >= 400) throw refused(text);
    const size_t at = head.find("\netag: ");
    if (etag && etag->empty() && at != std::string::npos) *etag = head.substr(at + 7, head.find('\r', at) - at - 7);
    return text;
}

static void wait() {
    std::this_thread::sleep_for(std::chrono::milliseconds(300));
    if (interrupted) throw std::runtime_error("interrupted");
}

static void stop() {
    try {
        ask("/v1/stop", "{}");
    } catch (...) {
        std::fputs("STOP WAS NOT CONFIRMED: use the emergency switch on the stimulator now\n", stderr);
    }
}

// A person has to look before the next trial where the muscle is no longer as it was approved.
static void end_if_asked(const std::string &code) {
    const json tracked = json::parse(ask("/v1/participants/" + code + "/model?tracked=true"));
    const json why = tracked.value("/tracking/ask"_json_pointer, json());
    if (why.is_string()) throw std::runtime_error("a person has to look first: " + why.get<std::string>());
}

static json start(const std::string &trial, std::string etag) {
    for (int attempt = 1;; attempt++) {  // the rig wants a rest between trials
        try {
            playing = true;
            return json::parse(ask("/v1/tests", trial, &etag));
        } catch (const refused &error) {
            playing = false;
            if (std::string(error.what()).find("rest-needed") == std::string::npos || attempt == 200) throw;
            wait();
        }
    }
}

// Play a trial and wait for its end: mean torque above rest in each pulse's period, N·m.
static Torque play(const std::string &code, double rate_hz, const std::string &etag, const json &widths_us) {
    const json rest = {{"name", "rest"}, {"sequence", "rest"}, {"settings", {{"duration_s", 1.0}}}};
    const json trial = {{"name", "trial"}, {"sequence", "widths"}, {"settings", {{"pulse_width_us", widths_us}}}};
    json test = {{"participant", code}, {"kind", "sequence"}, {"pulse_rate_hz", rate_hz}};
    test["segments"] = json::array({rest, trial, rest});
    test = start(test.dump(), etag);
    while (!test["done"].get<bool>()) {
        wait();
        test = json::parse(ask("/v1/tests/" + test["id"].get<std::string>()));
    }
    playing = false;
    if (test["state"] != "completed") throw std::runtime_error(test["reason"].get<std::string>());
    std::istringstream rows(ask("/v1/recordings/" + test["recording_id"].get<std::string>() + "/csv"));
    Torque sum(widths_us.size() + 1), count(sum.size());  // the first is the rest before the trial
    std::string row;
    std::getline(rows, row);
    double time_s, width_us, value_nm;
    while (std::getline(rows, row)) {
        if (std::sscanf(row.c_str(), "%lf,%lf,%lf", &time_s, &width_us, &value_nm) != 3) continue;
        const double period = std::floor((time_s - 1.0) * rate_hz) + 1;
        if (period >= sum.size()) continue;
        const size_t at = period < 1 ? 0 : static_cast<size_t>(period);
        sum[at] += value_nm, count[at] += 1;
    }
    Torque torque_nm;
    for (size_t k = 1; k < sum.size(); k++) torque_nm.push_back(sum[k] / count[k] - sum[0] / count[0]);
    return torque_nm;
}

static void learn(const std::string &code) {
    std::string etag;
    const json model = json::parse(ask("/v1/participants/" + code + "/model", "", &etag));
    const double rate_hz = model["pulse_rate_hz"], peak_nm = 0.5 * model["recruitment"]["inverse"]["torque_nm"].back().get<double>();
    const int size = static_cast<int>(std::lround(4 * rate_hz));
    Torque reference_nm(size), error_nm(size);
    for (int k = 0; k < size; k++) reference_nm[k] = peak_nm * std::pow(std::sin(M_PI * k / size), 2);
    Torque asked_nm = reference_nm;
    for (int number = 1; number <= 6; number++) {
        const std::string wanted = json{{"reference_torque_nm", asked_nm}}.dump();
        const json plan = json::parse(ask("/v1/models/" + model["model_id"].get<std::string>() + "/widths", wanted));
        const Torque torque_nm = play(code, rate_hz, etag, plan["pulse_width_us"]);
        double missed = 0, whole = 0;
        for (int k = 0; k < size; k++) {
            error_nm[k] = reference_nm[k] - torque_nm[k];
            missed += error_nm[k] * error_nm[k], whole += reference_nm[k] * reference_nm[k];
        }
        std::printf("trial %d: %.1f %%\n", number, 100 * std::sqrt(missed / whole));
        end_if_asked(code);
        for (int k = 0; k < size; k++) {  // smoothed: noise is not learnt
            double near = 0;
            for (int j = std::max(0, k - 3); j <= std::min(size - 1, k + 3); j++) near += error_nm[j] / 7;
            asked_nm[k] = std::max(0.0, asked_nm[k] + 0.7 * near);
        }
    }
}

int main() try {
    std::signal(SIGINT, [](int) { interrupted = 1; });
    std::signal(SIGTERM, [](int) { interrupted = 1; });
    try {
        learn("P017");
    } catch (...) {
        if (playing) stop();
        throw;
    }
} catch (const std::exception &error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
